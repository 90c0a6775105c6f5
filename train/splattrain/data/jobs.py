"""A whole data set as numbered scenes: scene k is object k (mod the objects) in a light of its own, and its samples.

A `RenderJob` is plain data that travels to workers; `render_scene(job, k)` depends on nothing else, so that scenes can
be made anywhere, in any order, again.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import torch

from splattrain.data.object_sources import (
    HELD_OUT_SHARE,
    SPLAT_SUFFIXES,
    MeshFolder,
    MeshSource,
    ObjectSource,
    ProceduralSource,
    SplatFolder,
    object_seed,
    split,
)
from splattrain.data.pathtrace import PathOptions
from splattrain.data.records import encode_sample
from splattrain.data.sample_recipes import SampleRecipe
from splattrain.data.samples import Sample, SampleStream
from splattrain.data.shards import Files, RenderedScene

Truth = Literal["surfels", "path"]
Part = Literal["all", "train", "validation"]
PROCEDURAL = "procedural:"


@dataclass(frozen=True)
class RenderJob:
    """What to render. Paths are as the workers see them."""

    source: str
    """`procedural:COUNT`, or a folder of meshes or of splat assets."""
    recipe: SampleRecipe
    """steps_per_object is the number of samples per scene."""
    truth: Truth = "surfels"
    seed: int = 0
    part: Part = "all"
    """Which objects: see scenes.split."""
    share: float = HELD_OUT_SHARE
    """Share of the objects that is for validation."""
    split_seed: int = 0
    environments: tuple[str, ...] = ()
    """Files of light (.hdr, .exr)."""
    decals: str = ""
    """Folders of stickers, fonts and photos; "" for built-in ones."""
    fonts: str = ""
    textures: str = ""
    path: PathOptions = field(default_factory=PathOptions)
    exr: bool = False
    """Path traced: keep 16-bit linear pictures too."""

    def spec(self) -> dict[str, Any]:
        """JSON values that decide what the samples are. Folders count by their files' names, not by where they are."""
        spec = asdict(self)
        for name in ("source", "environments", "decals", "fonts", "textures"):
            spec.pop(name)
        if self.truth == "surfels":
            spec.pop("path")
        source = open_source(self)
        objects = [source.name(i) for i in range(len(source))]
        spec["objects"] = {"count": len(objects), "names_sha256": _digest(objects)}
        spec["environments"] = [Path(path).name for path in self.environments]
        spec |= {name: _digest(_listing(getattr(self, name))) for name in ("decals", "fonts", "textures")}
        return spec


def open_source(job: RenderJob) -> ObjectSource:
    """The objects of a job. Raises ValueError: no such folder, nothing usable in it, a count that is none, an empty
    part."""
    source: ObjectSource
    if job.source.startswith(PROCEDURAL):
        count = job.source.removeprefix(PROCEDURAL)
        if not count.isdecimal() or int(count) < 1:
            raise ValueError(f"{job.source}: expected procedural:COUNT with a count from 1, got {count!r}")
        source = ProceduralSource(int(count), job.seed, job.textures or None)
    else:
        folder = Path(job.source)
        source = SplatFolder(folder) if holds_splats(folder) else MeshFolder(folder)
    if job.part == "all":
        return source
    names = [source.name(i) for i in range(len(source))]
    chosen = set(split(names, job.split_seed, job.share)[job.part == "validation"])
    numbers = [i for i, name in enumerate(names) if name in chosen]
    if not numbers:
        raise ValueError(f"{job.source}: none of its {len(names)} objects is in the {job.part} part of the split")
    return _Part(source, numbers)


def holds_splats(folder: Path) -> bool:
    """Whether the files directly in a folder are splat assets. A GLB is one where it says KHR_gaussian_splatting; with
    meshes among them, the folder is one of meshes."""
    files = [path for path in folder.iterdir() if path.is_file()] if folder.is_dir() else []
    has_gaussians = False
    for path in files:
        suffix = path.suffix.lower()
        if suffix in (".obj", ".gltf"):
            return False
        if suffix == ".glb":
            with open(path, "rb") as file:
                if b"KHR_gaussian_splatting" not in file.read(1 << 16):
                    return False
            has_gaussians = True
        has_gaussians |= suffix in SPLAT_SUFFIXES
    return has_gaussians


@contextlib.contextmanager
def one_torch_thread() -> Iterator[None]:
    """Sums by several have other last bits, and how many there are depends on the machine and on `--workers`."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@one_torch_thread()
def render_scene(job: RenderJob, number: int) -> RenderedScene:
    """Scene `number`: what cannot be made (a bad file, an edit that shows nowhere) is skipped, with the reason.

    Raises ValueError for what is no fault of the object: no Mitsuba, an unreadable light, a full disk."""
    source, environments = _opened(job)
    i, seed = number % len(source), object_seed(job.seed, number)
    name = source.name(i)
    make: Callable[[int], Any]
    if job.truth == "path":
        from splattrain.data.mitsuba_backend import use_mitsuba
        from splattrain.data.path_samples import PathScene

        use_mitsuba(job.path.variant)
        try:
            make = PathScene(cast(MeshSource, source), i, job.recipe, job.path, seed, environments).sample
        except ValueError as error:
            return RenderedScene(name, skipped=[str(error)])
    else:
        one = cast(ObjectSource, _Part(source, [i]))
        resources = (job.decals or (), job.fonts or (), job.textures or ())
        make = SampleStream(one, job.recipe, seed, environments, *resources).__getitem__
    samples, kinds, skipped = [], [], []
    for step in range(job.recipe.steps_per_object):
        try:
            rendered = make(step)
        except ValueError as error:
            if name in source.skipped:  # the object itself is bad: once is enough
                return RenderedScene(name, skipped=[source.skipped[name]])
            skipped.append(str(error))
            continue
        kind, files = _encoded(rendered, job.exr)
        kinds.append(kind)
        samples.append(files)
    return RenderedScene(name, samples, kinds, skipped)


def _encoded(rendered: Any, exr: bool) -> tuple[str, Files]:
    """made: a Sample, or a path_samples.Traced one."""
    if isinstance(rendered, Sample):
        return rendered.kind, encode_sample(rendered, truth="surfels")
    about = {"truth": "path", "exposure": rendered.exposure, "repaired_pixels": rendered.repaired}
    return rendered.sample.kind, encode_sample(rendered.sample, rendered.radiance if exr else None, **about)


class _Part:
    """Some objects of a source."""

    def __init__(self, source: Any, numbers: Sequence[int]) -> None:
        self._source, self._numbers = source, list(numbers)
        self.skipped: dict[str, str] = source.skipped
        for kind in ("mesh", "splats"):  # which of the two a source has says what it is
            if hasattr(source, kind):
                setattr(self, kind, self._reader(getattr(source, kind)))

    def __len__(self) -> int:
        return len(self._numbers)

    def name(self, i: int) -> str:
        return self._source.name(self._numbers[i])

    def _reader(self, read: Callable[[int], Any]) -> Callable[[int], Any]:
        return lambda i: read(self._numbers[i])


_opened_job: tuple[str, Any] | None = None


def _opened(job: RenderJob) -> tuple[Any, Sequence[Any]]:
    """(source, environments) of a job, kept for the process's next scene."""
    global _opened_job
    if _opened_job is None or _opened_job[0] != repr(job):
        from splattrain.data.environments import load_environment

        _opened_job = (repr(job), (open_source(job), tuple(load_environment(path) for path in job.environments)))
    return _opened_job[1]


def _listing(folder: str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir()) if folder else []


def _digest(names: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(names).encode()).hexdigest()
