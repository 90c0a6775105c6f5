"""What each system is given and which commands it is run with, as data: a Plan, which methods/external.py follows.

VoxHammer, VineDresser3D, DGE, Instruct-GS2GS and RelitLRM; docs/ADAPTERS.md tells users what to do for each.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatbench.adapters import datasets
from splatbench.adapters.adapters_file import GUIDE, AdapterSection
from splatbench.adapters.coordinate_frames import ASSET, Cube, Frame, nerfstudio_frame
from splatbench.methods import EditTask
from splatpainter.cameras import Camera
from splatpainter.color import to_display

TRELLIS_VIEWS, TRELLIS_PX = 150, 512
"""Renders that VoxHammer and VineDresser3D (whose main.py reads so many) get, and their size."""
PHOTO_VIEWS, PHOTO_PX = 48, 512
"""Renders that DGE and Instruct-GS2GS get."""
VOXHAMMER_FILES = ("inference.py", "voxhammer", "trellis", "assets/preset/preset_grid64.ply")
VINEDRESSER_FILES = ("main.py", "encode_asset/encode_into_SLAT.py", "PartField", "trellis")
VINEDRESSER_WRITES = (
    "outputs",
    "data",
    "PartField/data",
    "PartField/clustering_results",
    "PartField/partfield_features",
)
"""Folders that it writes to."""
VINEDRESSER_ASSET = "asset"
VINEDRESSER_PICTURE_PX = 518
"""Pixels of the edited picture."""
VINEDRESSER_KEYS = ("GEMINI_API_KEY", "GOOGLE_API_KEY")
DGE_FILES = ("launch.py", "configs/dge.yaml", "threestudio", "gaussiansplatting")
GS2GS_SETUP_STEPS = 20_000
"""Set-up steps, as its README says."""
GS2GS_GUIDANCE, GS2GS_IMAGE_GUIDANCE = "12.5", "1.5"
RELITLRM_VIEWS = 8
"""It takes 4 to 8."""
PLACEHOLDERS = {
    "python": "the interpreter of the section",
    "repository": "the checkout of the section",
    "asset": "the asset as INRIA PLY, in its own frame",
    "views": "folder of renders of the asset with cameras, in the layout that the system reads",
    "edited": "the edited view, PNG",
    "render": "the same view of the asset before, PNG",
    "mask": "what was edited of it, PNG, 255 where it was",
    "edits": "folder of all edited views: edited_, render_, mask_000.png and transforms.json",
    "region": "closed mesh (GLB) around what the edit reaches; VoxHammer only",
    "base": "folder of the posed views that the asset was built from; RelitLRM only",
    "prompt": "the instruction",
    "out": "folder for what the system makes",
    "seed": "a whole number",
}
"""Placeholders of `command` in the adapters file."""
DEFAULT_RESULT = "edited.ply"
"""What a command of the user's own leaves in {out}, unless `result` says otherwise."""
Commands = tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class AdapterJob:
    """One edit by one system."""

    work: EditTask
    section: AdapterSection
    folder: Path
    """Folder of the job's files: in/ (for the system), work/ (where it runs), out/ (what it makes), log.txt."""
    seed: int
    cube: Cube
    """Cube of the asset."""

    @property
    def inputs(self) -> Path:
        return self.folder / "in"

    @property
    def workplace(self) -> Path:
        return self.folder / "work"

    @property
    def out(self) -> Path:
        return self.folder / "out"

    @property
    def largest(self) -> int:
        """Index of the edited view with the largest mask, for systems that take one."""
        masks = self.work.step.masks
        return int(masks.reshape(len(masks), -1).sum(1).argmax())

    @property
    def prompt(self) -> str:
        return self.section.instruction(self.work.step.kind)


@dataclass(frozen=True)
class AdapterPlan:
    """How the system is run on what has been written for it."""

    edit: Commands
    """Timed as the edit."""
    result: Path
    """File that is read back."""
    frame: Callable[[], Frame]
    """Axes of the result, asked once it is there."""
    setup: Commands = ()
    """Timed as set-up, with the writing of the files."""
    export: Commands = ()
    """Only to make the result readable; timed apart."""
    values: dict[str, str] = field(default_factory=dict)
    """Placeholders beyond those that every job has."""
    check: Callable[[], None] = lambda: None
    """Asked between edit and export. Raises ValueError where the system ended well but did nothing."""
    note: str = ""
    """What the system saw of the edit."""


@dataclass(frozen=True)
class System:
    """A system: one row of the tables."""

    name: str
    """Name of its table in the adapters file, and of the method."""
    label: str
    protocols: tuple[str, ...]
    plan: Callable[[AdapterJob], AdapterPlan]
    """Writes what the system reads into job.inputs and job.workplace. Raises ValueError where it cannot."""
    needs: tuple[str, ...] = ()
    """Files of its checkout that must be there; (): it has none."""
    missing: Callable[[AdapterSection], str] = lambda _: ""
    """What else it needs that is not there, or ""."""


def write_common(job: AdapterJob) -> dict[str, str]:
    """Write what every system gets; the values of the placeholders."""
    from splatpainter import io
    from splatpainter.rendering import render

    work, edits = job.work, job.inputs / "edits"
    for folder in (edits, job.out):
        folder.mkdir(parents=True)
    io.write(job.inputs / "asset.ply", work.asset)
    datasets.save_text(job.inputs / "prompt.txt", job.prompt)
    step = work.step
    names = [f"edited_{k:03d}.png" for k in range(len(step.edited))]
    for k, camera in enumerate(step.edited.cameras):
        before = to_display(render(work.asset, camera).colors[0], work.asset.color_space)
        datasets.save_picture(edits / names[k], step.edited.colors[k])
        datasets.save_picture(edits / f"render_{k:03d}.png", before)
        datasets.save_picture(edits / f"mask_{k:03d}.png", step.masks[k].astype(bool))
    layout = datasets.transforms(step.edited.cameras, names)
    datasets.save_text(edits / "transforms.json", json.dumps(layout))
    largest = job.largest
    return {
        "python": job.section.python,
        "repository": str(job.section.repository or ""),
        "asset": str(job.inputs / "asset.ply"),
        "views": str(job.inputs / "views"),
        "edited": str(edits / names[largest]),
        "render": str(edits / f"render_{largest:03d}.png"),
        "mask": str(edits / f"mask_{largest:03d}.png"),
        "edits": str(edits),
        "prompt": job.prompt,
        "out": str(job.out),
        "seed": str(job.seed),
    }


def fill_placeholders(command: Iterable[str], values: dict[str, str]) -> tuple[str, ...]:
    """A command with its {placeholders} replaced. Raises ValueError for one that this system does not have."""

    def value(match: re.Match[str]) -> str:
        if match[1] not in values:
            raise ValueError(f"command: unknown placeholder {match[0]}; known here: {', '.join(sorted(values))}")
        return values[match[1]]

    return tuple(re.sub(r"\{([a-z_]+)\}", value, word) for word in command)


def with_user_command(plan: AdapterPlan, job: AdapterJob, values: dict[str, str]) -> AdapterPlan:
    """The plan with the user's own command, where the section has one."""
    section = job.section
    frames: dict[str, Callable[[], Frame]] = {
        "asset": lambda: ASSET,
        "gltf": lambda: job.cube.frame(upright=False),
        "trellis": lambda: job.cube.frame(upright=True),
    }
    frame, result = plan.frame, plan.result
    if section.command:
        result = job.out / (section.result or DEFAULT_RESULT)
        frame = plan.frame if section.result else frames["asset"]
    elif section.result:
        result = job.out / section.result
    if section.frame == "nerfstudio":
        frame = lambda: nerfstudio_frame(result.with_name("dataparser_transforms.json"))  # noqa: E731
    elif section.frame:
        frame = frames[section.frame]
    if not section.command:
        return replace(plan, result=result, frame=frame)
    return AdapterPlan((fill_placeholders(section.command, values),), result, frame, values=plan.values, note=plan.note)


def link_checkout(job: AdapterJob, *hidden: str) -> None:
    """job.workplace as a folder that looks like the checkout but takes what the system writes: links to all in it,
    except `hidden` (paths in it) and what is there already, which become folders of their own."""
    assert job.section.repository is not None
    _linked(job.section.repository, job.workplace, "", hidden)
    for name in hidden:
        (job.workplace / name).mkdir(parents=True, exist_ok=True)


def _linked(source: Path, target: Path, inside: str, hidden: tuple[str, ...]) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for entry in sorted(os.listdir(source)):
        path = f"{inside}{entry}"
        if path in hidden or entry == ".git":
            continue
        if any(name.startswith(f"{path}/") for name in hidden):
            _linked(source / entry, target / entry, f"{path}/", hidden)
        else:
            link(target / entry, (source / entry).resolve())


def link(path: Path, target: Path) -> None:
    """A symbolic link at `path`, or a copy where the system allows none (Windows asks for a privilege). target:
    absolute, or relative to the link's folder."""
    try:
        path.symlink_to(target, target_is_directory=(path.parent / target).is_dir())
    except OSError:
        if path.is_symlink() or path.exists():
            raise
        source = path.parent / target
        shutil.copytree(source, path) if source.is_dir() else shutil.copy2(source, path)


# ---- the systems


def voxhammer(job: AdapterJob) -> AdapterPlan:
    """VoxHammer (arXiv 2508.19247): an edit in TRELLIS's latents, within a 3D mask, led by an edited picture.

    Its inference.py skips Blender where its render folder is filled already; it is filled with renders of the asset
    itself, so the system sees the Gaussians and not a mesh made of them. What it makes is a textured mesh (GLB)."""
    section, step = job.section, job.work.step
    views, images, region = job.inputs / "views", job.inputs / "images", job.inputs / "region.glb"
    volume = datasets.edit_region(job.work.asset, job.cube, step.edited, step.masks)
    vertices, faces = datasets.voxel_surface(volume)
    datasets.write_glb(region, vertices / datasets.TRELLIS_VOXELS - 0.5, faces)  # y up: Blender turns it upright
    _write_trellis(job, views)
    images.mkdir()
    for name, source in (("2d_render", "render"), ("2d_edit", "edited"), ("2d_mask", "mask")):
        (images / f"{name}.png").write_bytes((job.inputs / "edits" / f"{source}_{job.largest:03d}.png").read_bytes())
    if not section.command:
        link_checkout(job, "outputs")
    command = (section.python, "inference.py", "--input_model", str(views / "mesh.ply"), "--mask_model", str(region))
    command += ("--image_dir", str(images), "--render_dir", str(views), "--output_dir", str(job.out))
    return AdapterPlan(
        edit=((*command, *section.arguments),),
        result=job.out / "output.glb",
        frame=lambda: job.cube.frame(upright=False),
        values={"region": str(region)},
        note=f"sees the edited view{_one_of(job)} and the region in 3D; its textured mesh is scored as dense flat "
        "Gaussians",
    )


def vinedresser(job: AdapterJob) -> AdapterPlan:
    """VineDresser3D (arXiv 2602.19542): an edit in TRELLIS's latents, the region found by language models from a text.

    Its main.py asks for nothing that is in its outputs folder already, so that folder is filled with renders of the
    asset itself (in place of Blender's of a mesh) and with the edited view (in place of one made by an image model: the
    paper gives both systems the same edited picture). It saves latents; decode_slat.py turns them into Gaussians."""
    from PIL import Image

    section, name = job.section, VINEDRESSER_ASSET
    if not section.command:
        link_checkout(job, *VINEDRESSER_WRITES)
    outputs = job.workplace / "outputs"
    for folder in ("img_edit/ID", "img_edit/img", "slat"):
        (outputs / folder).mkdir(parents=True, exist_ok=True)
    (job.workplace / "PartField" / "clustering_results" / "ply").mkdir(parents=True, exist_ok=True)
    views = outputs / "img_Enc" / name
    _write_trellis(job, views)
    with Image.open(job.inputs / "edits" / f"edited_{job.largest:03d}.png") as edited:
        picture = edited.resize((VINEDRESSER_PICTURE_PX, VINEDRESSER_PICTURE_PX), Image.Resampling.LANCZOS)
    picture.save(outputs / "img_edit" / "img" / f"{name}_editedImg.png")
    datasets.save_text(outputs / "img_edit" / "ID" / f"{name}_editImgID.txt", "0")
    latents = [str(outputs / "slat" / f"{name}_edited_{part}.pt") for part in ("feats", "coords")]
    encode = f"from encode_asset.encode_into_SLAT import encode_into_SLAT; encode_into_SLAT({name!r})"
    decode = (Path(__file__).parent / "decode_slat.py").read_text(encoding="utf-8")
    edit = (section.python, "main.py", "--input_file", f"{name}.glb", "--editing_prompt", job.prompt)
    result = job.out / "edited.ply"
    return AdapterPlan(
        setup=((section.python, "-c", encode),),
        edit=((*edit, *section.arguments),),
        export=((section.python, "-c", decode, *latents, str(result)),),
        result=result,
        frame=lambda: job.cube.frame(upright=True),
        values={"views": str(views)},
        note=f'sees the edited view{_one_of(job)} and the text "{job.prompt}"; it finds the region itself',
    )


def missing_of_vinedresser(section: AdapterSection) -> str:
    """It asks Google's models over the network, and its number of views is fixed."""
    if section.views not in (0, TRELLIS_VIEWS) and not section.command:
        return f"[vinedresser3d] views: its main.py reads {TRELLIS_VIEWS}, got {section.views}"
    if section.command or any(os.environ.get(key) or section.environment.get(key) for key in VINEDRESSER_KEYS):
        return ""
    return f"needs a key for Google's models: set {' or '.join(VINEDRESSER_KEYS)} in the environment"


def dge(job: AdapterJob) -> AdapterPlan:
    """DGE (arXiv 2404.18929): pictures edited together by InstructPix2Pix, then Gaussians optimised on them. Led by
    text alone. It reads the asset's PLY and a COLMAP scene, and writes a PLY in the same frame."""
    section = job.section
    datasets.write_colmap(job.inputs / "views", job.work.asset, _photo_cameras(job))
    if not section.command:
        link_checkout(job, "outputs", "edit_cache")
    settings = {
        "data.source": str(job.inputs / "views"),
        "system.gs_source": str(job.inputs / "asset.ply"),
        "system.prompt_processor.prompt": job.prompt,
        "system.cache_dir": "edit",
        "exp_root_dir": str(job.out),
        "tag": "edit",
        "use_timestamp": False,
        "seed": job.seed,
    }
    # Its values are read as YAML, of which JSON is a part.
    words = tuple(f"{key}={json.dumps(value)}" for key, value in settings.items())
    edit = (section.python, "launch.py", "--config", "configs/dge.yaml", "--train", *words, *section.arguments)
    return AdapterPlan(
        edit=(edit,),
        result=job.out / "dge" / "edit" / "save" / "last.ply",
        frame=lambda: ASSET,
        note=f'sees the text "{job.prompt}" alone, not the edited view',
    )


def instruct_gs2gs(job: AdapterJob) -> AdapterPlan:
    """Instruct-GS2GS: a nerfstudio plug-in that edits training pictures by InstructPix2Pix while Gaussians are
    optimised. Led by text alone. It starts from a checkpoint of nerfstudio's splatfacto, not from Gaussians: set-up
    trains one on renders of the asset."""
    section, out = job.section, job.out
    datasets.write_nerfstudio(job.inputs / "views", job.work.asset, _photo_cameras(job))

    def train(method: str, experiment: str) -> tuple[str, ...]:
        folder = ("--output-dir", str(out), "--experiment-name", experiment, "--timestamp", "run")
        end = ("--viewer.quit-on-train-completion", "True", "--machine.seed", str(job.seed))
        black = ("--pipeline.model.background-color", "black")
        words = (section.python, "-m", "nerfstudio.scripts.train", method, "--data", str(job.inputs / "views"))
        return (*words, *folder, *end, *black)

    start, edited = out / "setup" / "splatfacto" / "run" / "nerfstudio_models", out / "edit" / "igs2gs" / "run"
    guide = ("--pipeline.guidance-scale", GS2GS_GUIDANCE, "--pipeline.image-guidance-scale", GS2GS_IMAGE_GUIDANCE)
    edit = (*train("igs2gs", "edit"), "--load-dir", str(start), "--pipeline.prompt", job.prompt, *guide)
    setup = (*train("splatfacto", "setup"), "--max-num-iterations", str(GS2GS_SETUP_STEPS), *section.setup_arguments)
    export = (section.python, "-m", "nerfstudio.scripts.exporter", "gaussian-splat")
    return AdapterPlan(
        setup=(setup,),
        edit=((*edit, *section.arguments),),
        export=((*export, "--load-config", str(edited / "config.yml"), "--output-dir", str(out / "export")),),
        result=out / "export" / "splat.ply",
        frame=lambda: nerfstudio_frame(edited / "dataparser_transforms.json"),
        check=lambda: check_gs2gs_steps(start, edited / "nerfstudio_models"),
        note=f'sees the text "{job.prompt}" alone, not the edited view; edits a re-trained copy of the asset',
    )


def check_gs2gs_steps(start: Path, end: Path) -> None:
    """Raises ValueError where the edit took no step: nerfstudio's releases to 1.1.5 count --max-num-iterations from the
    loaded checkpoint, its main branch since November 2024 from 0, and then 7,500 end before they begin."""
    first, last = (_last_checkpoint(folder) for folder in (start, end))
    if last <= first:
        raise ValueError(
            f"Instruct-GS2GS took no step (last checkpoints: set-up {first}, edit {last}); where nerfstudio counts the "
            'set-up\'s steps too, set arguments = ["--max-num-iterations", "27500"]'
        )


def _last_checkpoint(folder: Path) -> int:
    """Step of the last checkpoint, -1 where there is none."""
    names = [re.fullmatch(r"step-(\d+)\.ckpt", path.name) for path in folder.glob("step-*.ckpt")]
    return max((int(match[1]) for match in names if match), default=-1)


def relitlrm(job: AdapterJob) -> AdapterPlan:
    """RelitLRM (arXiv 2410.06231): Gaussians under a new light from 4 to 8 posed views and an environment map, by
    diffusion.

    No code of it is public: there is a row only for a command of the user's own. The paper gives it the target's
    environment map; methods of these tables get relit views instead (EditTask has no map), so a command gets those."""
    base = job.work.base
    count = min(job.section.views or RELITLRM_VIEWS, len(base))
    chosen = base.take(np.linspace(0, len(base), count, endpoint=False).astype(int))
    datasets.write_posed(job.inputs / "base", chosen)
    link(job.inputs / "views", Path("base"))
    return AdapterPlan(
        edit=(),
        result=job.out / DEFAULT_RESULT,
        frame=lambda: ASSET,
        values={"base": str(job.inputs / "base")},
        note=f"sees {count} views in the source light and {len(job.work.step.edited)} relit; no environment map",
    )


def missing_of_relitlrm(section: AdapterSection) -> str:
    """It has no command of its own."""
    if not section.command:
        return f"no code is public: [relitlrm] needs a `command` of your own ({GUIDE})"
    if any("{environment_map}" in word for word in section.command):
        return "the target's environment map is not among what methods are given: use the relit views in {edits}"
    return ""


SYSTEMS = (
    System("voxhammer", "VoxHammer", ("creative",), voxhammer, VOXHAMMER_FILES),
    System("vinedresser3d", "VineDresser3D", ("creative",), vinedresser, VINEDRESSER_FILES, missing_of_vinedresser),
    System("dge", "DGE", ("creative",), dge, DGE_FILES),
    System("instruct-gs2gs", "Instruct-GS2GS", ("creative",), instruct_gs2gs),
    System("relitlrm", "RelitLRM", ("relight",), relitlrm, missing=missing_of_relitlrm),
)


def _write_trellis(job: AdapterJob, folder: Path) -> None:
    views, pixels = job.section.views or TRELLIS_VIEWS, job.section.size or TRELLIS_PX
    datasets.write_trellis(folder, job.work.asset, job.cube, count=views, pixels=pixels)


def _photo_cameras(job: AdapterJob) -> list[Camera]:
    views, pixels = job.section.views or PHOTO_VIEWS, job.section.size or PHOTO_PX
    return datasets.cameras_on_rings(job.cube, views, pixels=pixels)


def _one_of(job: AdapterJob) -> str:
    """A note's part where the system took one view of several."""
    views = len(job.work.step.edited)
    return f", the one with the largest mask of {views}" if views > 1 else ""
