"""The source `command`: what the program is given, what it answers, how it ends, and that no shell sees anything."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.sources.backends import command
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest, SourceCancelled, SourceError
from splatpainter.sources.registry import open_source
from tests.support.picture_requests import HEIGHT, WIDTH, HastyClock, Progressed, request, script
from tests.support.systems import posix_only

COPY = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"
REPORT = """
import json, sys
from pathlib import Path
from PIL import Image
out, report, *rest = sys.argv[1:]
files = {Path(w).name: (Image.open(w).size, Image.open(w).mode) for w in rest if w.endswith(".png")}
Path(report).write_text(json.dumps({"words": rest, "files": files}))
Image.new("RGBA", (64, 48), (255, 0, 0, 128)).save(out)
"""


def run(template: str, query: PictureRequest | None = None, progress: Progressed | None = None, **options: str):
    progress = progress or Progressed()
    source = open_source("command", {"run": f'"{sys.executable}" {template}', **options})
    return source.edit(query or request(), progress, progress.cancel)


def test_a_picture_there_and_back(tmp_path: Path) -> None:
    answer: PictureAnswer = run(f'"{script(tmp_path, COPY)}" {{image}} {{out}}')
    assert answer.image.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(answer.image - request().image).max() <= 0.5 / 255 + 1e-6


def test_everything_that_a_template_can_name(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    names = "{image} {mask} {alpha} {depth} {normal} {camera} --prompt={prompt} {seed} x{scale} {references} {prompt}"
    template = f'"{script(tmp_path, REPORT)}" {{out}} "{report}" {names}'
    prompt = "a 'rusty\"; touch x\n$(touch y) {seed} `z`"
    answer = run(template, request(prompt, True, 7, 2, 4, True))
    assert answer.image.shape == (48, 64, 4) and answer.image[0, 0, 3] == pytest.approx(128 / 255)
    assert (answer.seed, answer.model) == (7, f"{Path(sys.executable).name} tool.py")
    words = json.loads(report.read_text("utf-8"))
    assert words["words"][6:9] == [f"--prompt={prompt}", "7", "x4"] and words["words"][-1] == prompt
    assert words["files"] == {
        "image.png": [[WIDTH, HEIGHT], "RGB"],
        "mask.png": [[WIDTH, HEIGHT], "L"],
        "alpha.png": [[WIDTH, HEIGHT], "L"],
        "depth.png": [[WIDTH, HEIGHT], "I;16"],
        "normal.png": [[WIDTH, HEIGHT], "RGB"],
        "reference_0.png": [[8, 8], "RGB"],
        "reference_1.png": [[8, 8], "RGB"],
    }
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.json", "tool.py"]
    assert not Path(words["words"][0]).parent.exists()


def test_it_takes_what_its_template_names() -> None:
    python = f'"{sys.executable}"'
    plain = open_source("command", {"run": f"{python} {{image}} {{out}}"}).capabilities
    assert not (plain.prompt or plain.mask or plain.seed or plain.references or plain.maps) and plain.scales == (1,)
    full = open_source("command", {"run": f"{python} {{prompt}}{{mask}}{{seed}}{{depth}}x{{scale}} {{out}}"})
    assert full.capabilities.prompt and full.capabilities.mask and full.capabilities.seed
    assert full.capabilities.maps == {"depth"} and full.capabilities.scales == (1, 2, 4)


@pytest.mark.parametrize(
    ("template", "line"),
    [
        ("", "run is empty"),
        ("'", "cannot be split into arguments (no closing quotation)"),
        ("python {image}", "needs {out}"),
        ("python {picture} {out}", "run has no {picture}; there are {image} {alpha} {mask}"),
        ("no-such-program-here {out}", "program 'no-such-program-here' not found; give its path"),
        ("{image} {out}", "has to begin with a program"),
        ("python --refs={references} {out}", "{references} has to be an argument of its own"),
    ],
)
def test_templates_that_are_refused(template: str, line: str) -> None:
    with pytest.raises(SourceError) as error:
        open_source("command", {"run": template})
    assert line in str(error.value)


@pytest.mark.parametrize(
    ("body", "line"),
    [
        ("pass", "ended well and wrote no picture to {out}"),
        ("print('out of memory')", "wrote no picture to {out}; it said: out of memory"),
        (
            "import sys; print('a\\nno GPU\\n\\n', file=sys.stderr); sys.exit(3)",
            "failed with exit code 3; it said: no GPU",
        ),
        (
            "import sys; open(sys.argv[1], 'w').write('<html>')",
            "its picture: expected a PNG, JPEG, WebP, TIFF, OpenEXR, Radiance, PSD, PSB, OpenRaster or Krita picture",
        ),
        ("import sys; open(sys.argv[1], 'w')", "its picture: is empty"),
        ("import os, sys; os.mkdir(sys.argv[1])", "its picture: is a folder"),
    ],
)
def test_programs_that_go_wrong(tmp_path: Path, body: str, line: str) -> None:
    with pytest.raises(SourceError) as error:
        run(f'"{script(tmp_path, body)}" {{out}}')
    assert line in str(error.value) and "\n" not in str(error.value)


def test_pictures_that_are_refused(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (8, 8), (shade, 0, 0)) for shade in (0, 255)]
    frames[0].save(tmp_path / "moving.png", save_all=True, append_images=frames[1:])
    Image.new("CMYK", (8, 8)).save(tmp_path / "inks.tif")
    copy = script(tmp_path, COPY)
    with pytest.raises(SourceError, match="expected a still picture, got PNG with 2 frames"):
        run(f'"{copy}" "{tmp_path / "moving.png"}" {{out}}')
    with pytest.raises(SourceError, match="expected RGB colours, got CMYK; save it as RGB"):
        run(f'"{copy}" "{tmp_path / "inks.tif"}" {{out}}', ending="tif")


def test_a_program_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = "import time; print('loading', flush=True); time.sleep(60)"
    clock = HastyClock("loading")
    monkeypatch.setattr(command, "time", clock)
    with pytest.raises(SourceError, match="did not end within 600 seconds; it said: loading"):
        run(f'"{script(tmp_path, body)}" {{out}}', progress=clock.progress())


@posix_only
def test_cancel_ends_the_program_and_what_it_started(tmp_path: Path) -> None:
    beat = tmp_path / "beat"
    child = f"import time\nwhile True: open({str(beat)!r}, 'a').write('.'); time.sleep(0.02)"
    body = f"import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', {child!r}])\n"
    body += f"import os\nwhile not os.path.exists({str(beat)!r}): time.sleep(0.01)\n"
    body += "print('step 40%', flush=True); time.sleep(60)"
    progress = Progressed("40%")
    with pytest.raises(SourceCancelled):
        run(f'"{script(tmp_path, body)}" {{out}}', progress=progress)
    assert (0.4, "step 40%") in progress.reports
    size = beat.stat().st_size
    import time

    time.sleep(0.1)
    assert beat.stat().st_size == size


def test_a_prompt_is_no_option(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="a prompt that begins with '-' would be read as an option"):
        run(f'"{script(tmp_path, COPY)}" {{prompt}} {{out}}', request("--out=/etc/passwd"))


@pytest.mark.parametrize("scales", ["0", "2,x", "", "99"])
def test_scales_that_are_wrong(scales: str) -> None:
    with pytest.raises(SourceError, match="scales: expected whole numbers of 1 to 16"):
        open_source("command", {"run": f'"{sys.executable}" {{scale}} {{out}}', "scales": scales})
