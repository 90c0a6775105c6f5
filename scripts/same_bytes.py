"""What the program makes of a fixed set of command lines, jobs and a session, as a list of hashes: two states of the
tree that print the same list write the same bytes and say the same words.

    python scripts/same_bytes.py FOLDER                      # some 220 files and FOLDER/sums.txt, in a minute or two
    python scripts/same_bytes.py OTHER --against FOLDER      # the same, and what differs; exit 1 if anything does
    python scripts/same_bytes.py FOLDER --at-once 3          # and all once more on each of three threads, as above

Small inputs, made here. Everything runs in one process and in FOLDER, so that no path gets into a text. Hashed are the
bytes of assets and pictures; of receipts, projects, pages and of what was printed the text, with seconds, dates,
versions and hashes of jobs struck out.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import shutil
import sqlite3
import sys
import threading
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image, ImageDraw, PngImagePlugin
from tyro.conf import Positional

from splatpainter.cli import main as run_command
from splatpainter.splats import SH_C0, Splats

SUMS = "sums.txt"
BOX = (40, 44, 55, 53)
"""A rectangle on the asset in its first view of 96 pixels: left, top, right, bottom."""
SECONDS = re.compile(r"\b\d+\.\d\d s\b")
STRUCK_KEYS = re.compile(r'"(core|seconds|stages|edited|created|version|job_sha256)": ("[^"]*"|[\d.]+|\{[^{}]*\})')
VERSIONS = re.compile(r"splatpainter \d+\.\d+\.\d+[\w.+]*")
HEX_NAMES = re.compile(r"\b[0-9a-f]{16,64}\b")
TEXT_ENDINGS = (".json", ".txt", ".html", ".yaml", ".csv")
TOOL = """
import sys
import numpy as np
from PIL import Image
pixels = np.asarray(Image.open(sys.argv[1]).convert("RGB"))
Image.fromarray(pixels[..., [2, 0, 1]]).save(sys.argv[2])
"""
"""A picture source: exchanges the channels."""

COMMANDS = """
info ball.ply
render ball.ply --out views --views 3 --size 96
render ball.ply --out passes --views 1 --size 64 --aov depth,normal
convert ball.ply ball.spz
convert ball.ply ball.sog
convert ball.ply ball.splat
convert ball.ply ball.compressed.ply
convert ball.ply ball.glb
convert ball.spz from_spz.ply
convert ball.sog from_sog.ply
convert ball.ply turned.ply --axes rub
merge ball.ply egg.ply --out merged.ply
:paint
edit ball.ply painted.png --out edit_local.ply
edit ball.spz painted.png --out edit_local.spz
edit ball.ply painted.png --out edit_fit.ply --method fit
edit ball.ply painted.png painted_1.png --out edit_two.ply --preset lift
edit ball.ply painted.png --camera views/view_000.json --mask mask.png --out edit_mask.ply --angle-limit 0 --json
edit ball.ply warm.png --mode global --method lift --out edit_global.ply
edit ball.ply warm.png --mode global --out edit_global_auto.ply
edit ball.ply painted.png --mode spread --spread-confidence sure.png --spread-threshold 0.4 --out edit_spread.ply
edit ball.ply painted.png --mode spread --dry-run --out none.ply
edit ball.ply mirrored.png --correct --out edit_corrected.ply
edit ball.ply warm.png --force --out edit_forced.ply
edit merged.ply painted.png --out edit_merged.ply
edit ball.ply --decal label.png --at 48,48 --camera views/view_000.json --width 20% --out decal.ply
edit ball.ply --decal-text Ab --at 40,40 --camera views/view_000.json --width 0.5 --angle 30 \
--decal-color #20406f --out word.ply
edit ball.ply --source command --source-option RUN --azimuth 90 --size 96 --out sourced.ply --source-strictness loose
edit ball.ply --source command --source-option RUN --mask mask.png --size 96 --out sourced_mask.ply \
--source-strictness loose --source-report report.png --json
edit ball.ply --source command --source-option RUN --views auto --max-views 2 --size 96 --out \
around.ply --source-strictness loose
edit ball.ply --source command --source-option RUN --views auto --max-views 2 --size 96 --out none.ply --dry-run
edit ball.ply --source command --source-option RUN --size 96 --out none.ply --dry-run --json
grade ball.ply --exposure 0.5 --temperature 0.3 --out grade_sliders.ply
grade ball.ply --hue 90 --where y=..0 --out grade_hue.ply --json
grade ball.ply --look look.json --strength 0.5 --out grade_look.ply
grade ball.ply --lut film.cube --out grade_lut.ply
grade ball.ply --match warm.png --where mask=mask.png@views/view_000.json --out grade_match.ply
grade ball.ply --recolor #2040a0 --where sphere=0,0,-1,0.6 or hue=340..20 --out grade_recolor.ply
fill ball.ply --where sphere=0,0,-1,0.35 --out fill.ply
fill ball.ply --where sphere=0,0,-1,0.35 --remove selection --out fill_selection.ply --json
fill ball.ply --where sphere=0,0,-1,0.35 --source command --source-option RUN --out fill_source.ply \
--source-strictness loose
refine ball.ply --view views/view_000.json views/view_001.json --out refined.ply
refine ball.ply --view views/view_000.json --scale 4 --method fit --out refined_fit.ply --json
light ball.ply --sun 30,40,#ffe0b0,2 --point 0,-2,0 --out lit.ply
light ball.ply --hdri sunset --rotate 30 --exposure 0.5 --where y=..0 --mix 0.7 --out lit_sky.ply --json
delight ball.ply --out flat.ply
delight ball.ply --no-shadows --mix 0.5 --where y=0.. --out flat_half.ply
edit ball.ply paint painted.png grade --exposure 0.3 --where y=..0 fill --where sphere=0,0,-1,0.3 --out list.ply
pixelate ball.ply --where sphere=0,0,-1,0.5 --size 12% --out pixelated.ply
pixelate ball.ply --where x=0.. --style blur --merge --margin 1 --view views/view_000.json --out blurred.ply --json
verify ball.ply edit_local.ply
verify ball.ply decal.ply --json
verify merged.ply --against ball.ply egg.ply
compare ball.ply edit_local.ply --out compared --views 2 --size 64
turntable edit_local.ply --out turn.webp --seconds 1 --fps 3 --size 48
:session
grade ball.ply --look adjustment.splatlayer --out grade_layer.ply
grade ball.ply --exposure 0.2 --where layer=Stroke@project.splatproj --out grade_of_layer.ply
batch jobs.yaml --dry-run
batch jobs.yaml
batch jobs.yaml --json
batch wrong.yaml
"""
"""Command lines that make files, in order; `:name` is a step of this file, RUN the picture source."""
OUTPUTS = ("--out", "--spread-confidence", "--source-report")
"""Options of theirs that name what is made."""

REFUSALS = """
edit
edit ball.ply
edit ball.ply --out x.ply
edit ball.ply painted.png
edit ball.ply painted.png --out x.xyz
edit ball.ply nothing.png --out x.ply
edit nothing.ply painted.png --out x.ply
edit ball.ply painted.png --out ball.ply
edit ball.ply painted.png --out decal.ply
edit ball.ply painted.png --out x.ply --receipt x.ply
edit ball.ply painted.png --out x.ply --mode best
edit ball.ply painted.png --out x.ply --sped 1
edit ball.ply painted.png --out x.ply --mask mask.png mask.png
edit ball.ply painted.png --out x.ply --spread-threshold 0.3
edit ball.ply painted.png --out x.ply --force --correct
edit ball.ply painted.png --out x.ply --prompt hello
edit ball.ply painted.png --out x.ply --dry-run
edit ball.ply painted.png --out x.ply --preset nothing
edit ball.ply painted.png --out x.ply --polish --method lift
edit ball.ply painted.png --out x.ply --method ttt --preset lift
edit ball.ply painted.png --out x.ply --at 3,3
edit ball.ply painted.png --out x.ply --out y.ply
edit ball.ply views/view_000.png --out x.ply
edit ball.ply warm.png --out x.ply
edit ball.ply mirrored.png --out x.ply
edit ball.ply painted.png --decal label.png --at 3,3 --width 3 --out x.ply
edit ball.ply --decal label.png --decal-text Ab --at 3,3 --width 3 --camera views/view_000.json --out x.ply
edit ball.ply --decal label.png --at 3 --width 3 --camera views/view_000.json --out x.ply
edit ball.ply --decal label.png --at 3,3 --width -3 --camera views/view_000.json --out x.ply
edit ball.ply --decal label.png --at 3,3 --camera views/view_000.json --out x.ply
edit ball.ply --decal label.png --at 3,3 --width 3 --out x.ply
edit ball.ply --decal-text Ab --decal-color red --at 3,3 --width 3 --camera views/view_000.json --out x.ply
edit ball.ply --decal label.png --at 1,1 --width 3 --camera views/view_000.json --out x.ply
edit ball.ply --decal label.png --at 3,3 --width 3 --camera views/view_000.json --mode global --out x.ply
edit ball.ply --source nothing --out x.ply
edit ball.ply --source command --out x.ply
edit ball.ply painted.png --source command --out x.ply
edit ball.ply --source command --source-option RUN --views auto --mode global --out x.ply
edit ball.ply --source command --source-option RUN --max-views 3 --out x.ply
edit ball.ply --source command --source-option RUN --size 3 --out x.ply
edit ball.ply --source command --source-option RUN --elevation 100 --out x.ply
edit ball.ply --source command --source-option RUN --view views/view_000.json --azimuth 3 --out x.ply
edit ball.ply --source command --source-option RUN --mode spread --out x.ply
grade ball.ply --out x.ply
grade ball.ply --exposure 99 --out x.ply
grade ball.ply --exposure 1 --recolor #123456 --out x.ply
grade ball.ply --recolor red --out x.ply
grade ball.ply --exposure 1 --strength 0 --out x.ply
grade ball.ply --exposure 1 --where size --out x.ply
grade ball.ply --exposure 1 --where x=90.. --out x.ply
grade ball.ply --look nothing.json --out x.ply
grade ball.ply --lut look.json --out x.ply
fill ball.ply --out x.ply
fill ball.ply --where x=0.. --around x=0.. --out x.ply
fill ball.ply --where sphere=0,0,-1,0.3 --prompt hello --out x.ply
refine ball.ply --out x.ply
refine ball.ply --view views/view_000.json --upscale label.png --source command --out x.ply
light ball.ply --out x.ply
light ball.ply --sun 3 --out x.ply
light ball.ply --sun 3,4 --mix 0 --out x.ply
delight ball.ply --mix 2 --out x.ply
delight ball.ply --up q --out x.ply
verify ball.ply egg.ply
"""
"""Command lines that are refused; their words are compared."""

JOBS = """
assets: [ball.ply, egg.ply]
out: results
edits:
  - grade: {exposure: 0.2}
variants:
  - name: painted
    edits:
      - pictures: {files: [painted.png], preset: lift}
  - name: word
    edits:
      - decal: {text: "{asset}", at: [48, 48], camera: views/view_000.json, width: 30%}
      - grade: {recolor: "#408020", where: [hue=200..250]}
  - name: sourced
    edits:
      - source: {name: command, options: {run: 'RUN'}, size: 96, strictness: loose, mask: mask.png}
  - name: layers
    edits:
      - layers: {project: project.splatproj, only: [Stroke]}
  - name: refined
    edits:
      - refine: {views: [views/view_000.json]}
preview: {size: 32}
"""


@dataclass(frozen=True)
class Options:
    """Make the files and their hashes."""

    folder: Positional[Path]
    """Where; made anew."""
    against: Annotated[Path | None, tyro.conf.arg(metavar="OTHER")] = None
    """A folder that was made before; what differs is printed."""
    at_once: int = 0
    """Threads that each make everything once more, all at once; what differs is printed."""


def ball(count: int = 2500, degree: int = 2) -> Splats:
    """A sphere of flat opaque Gaussians with a red cap and bands of other colours, that look different from aside."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = k * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z * z)
    normals = np.stack([across * np.cos(angle), across * np.sin(angle), z], 1)
    sh = np.random.default_rng(7).normal(0, 0.02, (count, (degree + 1) ** 2, 3))
    colors = np.where(normals[:, 1:2] < -0.8, [0.9, 0.1, 0.1], [0.5, 0.55, 0.7])
    colors = np.where(np.sin(9 * normals[:, :1]) > 0.6, [0.3, 0.6, 0.3], colors)
    sh[:, 0] = (colors - 0.5) / SH_C0
    half = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], 1)
    half[normals[:, 2] < -0.999] = (0, 1, 0, 0)
    size = 1.5 * np.sqrt(4 * np.pi / count)
    scales = np.repeat([[size / 2, size / 2, size / 40]], count, 0)
    arrays = (normals, half, scales, np.full(count, 0.95), sh)
    means, quats, scales, opacities, sh = (array.astype(np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, sh)


def make_inputs() -> None:
    from splatpainter.io import write

    write(Path("ball.ply"), ball())
    egg = ball(1200, 1)
    write(Path("egg.ply"), replace(egg, means=(egg.means * [0.8, 1.2, 0.8] + [0, 0, 0.1]).astype(np.float32)))
    Path("tool.py").write_text(TOOL, encoding="utf-8")
    Path("jobs.yaml").write_text(JOBS.replace("RUN", _tool()), encoding="utf-8")
    Path("wrong.yaml").write_text(JOBS.replace("exposure: 0.2", "exposition: 0.2"), encoding="utf-8")
    Path("look.json").write_text(
        json.dumps({"exposure": 0.3, "hues": [{"hue": 30, "width": 60, "shift": 40}]}), encoding="utf-8"
    )
    table = [f"{r} {g} {b}" for b in (0, 1) for g in (0, 0.9) for r in (0.1, 1)]
    Path("film.cube").write_text("LUT_3D_SIZE 2\n" + "\n".join(table) + "\n", encoding="utf-8")
    Image.new("RGBA", (24, 12), (200, 30, 40, 255)).save("label.png")
    mask = np.zeros((96, 96), np.uint8)
    mask[30:70, 30:70] = 255
    Image.fromarray(mask).save("mask.png")


def paint() -> None:
    """Edited pictures of the rendered views."""

    def edited(source: str, target: str, change: Callable[[Image.Image], Image.Image]) -> None:
        with Image.open(source) as picture:
            texts, copy = dict(getattr(picture, "text", {})), picture.convert("RGB")
        chunk = PngImagePlugin.PngInfo()
        for key, value in texts.items():
            chunk.add_text(key, value)
        change(copy).save(target, pnginfo=chunk)

    def box(picture: Image.Image) -> Image.Image:
        ImageDraw.Draw(picture).rectangle(BOX, fill=(20, 160, 40))
        return picture

    edited("views/view_000.png", "painted.png", box)
    edited("views/view_001.png", "painted_1.png", box)
    edited("views/view_000.png", "warm.png", lambda p: p.point([min(int(v * 1.2), 255) for v in range(256)] * 3))
    edited("views/view_000.png", "mirrored.png", lambda p: box(p).transpose(Image.Transpose.FLIP_LEFT_RIGHT))


def session() -> None:
    """A project with strokes, a mask, an eraser, hidden Gaussians, an adjustment and undo; its exports."""
    from splatpainter.decals.decals import Decal
    from splatpainter.image_files import find_camera
    from splatpainter.painter import Edit, Painter
    from splatpainter.session import Session

    camera = find_camera(Path("views/view_000.png"))
    mask = np.zeros((96, 96), bool)
    mask[40:55, 30:60] = True
    image = np.full((96, 96, 3), (0.9, 0.7, 0.1), np.float32)
    with Session(Path("ball.ply"), painter=Painter.load("lift")) as project:
        stroke = project.layers.add("paint", [Edit(image, camera, mask)], name="Stroke")
        project.layers.add("paint", [Edit(image[..., ::-1].copy(), camera, mask.T.copy())], name="Second")
        project.layers.set(stroke.id, opacity=0.6)
        decal = Decal("label.png", (48.0, 60.0), camera, "20%")
        project.layers.add("paint", decal.views(Painter.load("lift").encode(project.splats)), name="Label")
        project.undo()
        project.redo()
        project.undo()
        look = project.layers.add("look", look="grade", settings={"exposure": 0.4}, name="Warm")
        project.layers.hide_selected((project.splats.means[:, 0] > 0.9).astype(np.float32))
        project.files.save_as("project.splatproj")
        project.files.export("project.ply")
        project.files.export("project.spz", remove_hidden=True)
        project.files.export_layer(stroke.id, "stroke.splatlayer")
        project.files.export_layer(look.id, "adjustment.splatlayer")
    with Session.load("project.splatproj") as project:
        project.verify()


STEPS: dict[str, Callable[[], None]] = {"paint": paint, "session": session}


def _tool() -> str:
    return f"{Path(sys.executable).as_posix()} tool.py {{image}} {{out}}"


def said(line: str) -> str:
    """What a command line prints, its options and its exit code."""
    words = [f"run={_tool()}" if word == "RUN" else word for word in line.split()]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run_command(words)
    return f"$ {line}\n{out.getvalue()}{err.getvalue()}exit {code}\n"


def struck(text: str) -> str:
    """A text without what differs from run to run."""
    text = text.replace(sys.executable, "python").replace(Path(sys.executable).as_posix(), "python")
    for pattern, word in ((SECONDS, "N s"), (VERSIONS, "splatpainter V"), (STRUCK_KEYS, r'"\1": N')):
        text = pattern.sub(word, text)
    return text


def content(path: Path) -> bytes:
    """What of a file is compared."""
    if path.suffix == ".splatproj":
        return dumped(path).encode()
    if path.suffix == ".splatlayer":
        with zipfile.ZipFile(path) as bundle:
            return b"\n".join(name.encode() + bundle.read(name) for name in sorted(bundle.namelist()))
    data = path.read_bytes()
    if path.name == "record.json" or path.suffix in TEXT_ENDINGS:
        text = struck(data.decode(errors="replace"))
        return re.sub(r"data:image/webp;base64,[\w+/=]+", "PICTURE", text).encode()
    return data


def dumped(path: Path) -> str:
    """The rows of a project, but for its random id, dates, seconds and the bytes of stored results, which `project.ply`
    shows."""
    with contextlib.closing(sqlite3.connect(path)) as database:
        tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type='table'")]
        lines = []
        for table in sorted(tables):
            for row in database.execute(f"SELECT * FROM {table}"):
                cells = [hashlib.sha256(c).hexdigest() if isinstance(c, bytes) else str(c) for c in row]
                if "edited" not in cells and (table, cells[0]) != ("facts", "id"):
                    lines.append(struck(" | ".join([table, *cells])))
    return "\n".join(sorted(lines))


def sums(folder: Path) -> dict[str, str]:
    """File -> hash. Folders that are named by hashes of job files keep their number."""
    out = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name not in (SUMS, "tool.py") and not path.name.startswith("."):
            name = HEX_NAMES.sub("HASH", path.relative_to(folder).as_posix())
            out[name] = hashlib.sha256(content(path)).hexdigest()
    return out


def make(folder: Path) -> dict[str, str]:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    before = Path.cwd()
    os.chdir(folder)
    try:
        make_inputs()
        printed = Path("printed")
        printed.mkdir()
        for line in COMMANDS.strip().splitlines():
            if line.startswith(":"):
                STEPS[line[1:]]()
            else:
                words, digest = re.sub(r"\W+", "_", line)[:60].strip("_"), hashlib.sha256(line.encode()).hexdigest()
                (printed / f"{words}_{digest[:6]}.txt").write_text(said(line), encoding="utf-8")
        refused = "\n".join(said(line) for line in REFUSALS.strip().splitlines())
        (printed / "refused.txt").write_text(refused, encoding="utf-8")
        out = sums(Path())
        Path(SUMS).write_text("".join(f"{digest}  {name}\n" for name, digest in out.items()), encoding="utf-8")
        return out
    finally:
        os.chdir(before)


def made_at_once(folder: Path, count: int) -> list[str]:
    """What differs from FOLDER where so many threads of this process run its command lines again, each in an order of
    its own and into a folder of its own. Texts are left out: they say where they lie."""
    lines = [line.split() for line in COMMANDS.strip().splitlines() if not line.startswith((":", "batch"))]
    differing: list[str] = []

    def work(thread: int) -> None:
        order = np.random.default_rng(thread).permutation(len(lines))
        for words in (lines[k] for k in order):
            outputs = [k + 1 for k, word in enumerate(words) if word in OUTPUTS]
            outputs = [2] if words[0] == "convert" else outputs
            there = [words[k] for k in outputs if Path(words[k]).exists()]
            if not there:
                continue
            moved = [f"{thread}/{word}" if k in outputs else word for k, word in enumerate(words)]
            try:
                code: object = run_command([f"run={_tool()}" if word == "RUN" else word for word in moved])
            except Exception as error:  # what a thread raises nobody else hears
                code = repr(error)
            for name in there:
                if code or _binaries(Path(name)) != _binaries(Path(str(thread), name)):
                    differing.append(f"{name} of thread {thread}: {' '.join(words)} ({code})")

    before, interval = Path.cwd(), sys.getswitchinterval()
    os.chdir(folder)
    for thread in range(count):
        Path(str(thread)).mkdir()
    # With a GIL threads take turns five hundred times as often.
    sys.setswitchinterval(1e-5)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            threads = [threading.Thread(target=work, args=(thread,)) for thread in range(count)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
    finally:
        sys.setswitchinterval(interval)
        os.chdir(before)
    return sorted(differing)


def _binaries(path: Path) -> dict[str, str]:
    """File -> hash of an asset, a picture, or of all of them in a folder."""
    if not path.is_dir():
        return {path.name: hashlib.sha256(content(path)).hexdigest()} if path.exists() else {}
    return {name: digest for name, digest in sums(path).items() if not name.endswith(TEXT_ENDINGS)}


def read_sums(folder: Path) -> dict[str, str]:
    lines = (folder / SUMS).read_text(encoding="utf-8").splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def main() -> int:
    options = tyro.cli(Options, description=__doc__)
    made = make(options.folder)
    print(f"{len(made)} files in {options.folder}")
    if options.at_once:
        other_bytes = made_at_once(options.folder, options.at_once)
        print("\n".join([*other_bytes, f"{options.at_once} threads at once: {len(other_bytes)} files differ"]))
        if other_bytes:
            return 1
    if options.against is None:
        return 0
    other = read_sums(options.against)
    differing = [name for name in sorted(made.keys() | other.keys()) if made.get(name) != other.get(name)]
    for name in differing:
        state = "new" if name not in other else "missing" if name not in made else "differs"
        print(f"{state}: {name}")
    print(f"{len(made.keys() & other.keys()) - sum(n in made and n in other for n in differing)} files are the same")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
