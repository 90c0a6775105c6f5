"""`splatpainter light` and `delight`: files in, proved files out; and what they refuse, with nothing written."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.io import read
from splatpainter.lights.light_words import parse_lamp, parse_sun, white_of
from splatpainter.lights.skies import SKIES
from splatpainter.lights.sky_maps import SkyMap, write_sky
from tests.support.cli_scenes import Capture, ball, listing, rows_of, run, saved


@pytest.fixture()
def asset(tmp_path: Path) -> Path:
    return saved(tmp_path / "ball.ply", ball(1200))


def test_untouched_gaussians_keep_their_bytes_and_verify_agrees(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "lit.ply"
    words = ["--sun", "30,40,#ffe0b0,2", "--where", "y=..0", "--out", out]
    done = run(capfd, "light", asset, *words)
    assert done.code == 0 and "sun 30,40 of 2" in done.out and "source light:" in done.out and "y=..0" in done.out
    same = (rows_of(asset) == rows_of(out)).all(1)
    assert same[read(asset).means[:, 1] > 0].all() and not same[read(asset).means[:, 1] <= 0].any()
    receipt = json.loads((tmp_path / "lit.ply.receipt.json").read_text())
    assert receipt["mode"] == "light" and receipt["method"] == "ratio" and receipt["appended_rows"] == 0
    assert run(capfd, "verify", asset, out).code == 0


def test_every_kind_of_light_shines(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    lights = {
        "hdri": "studio", "sun": "0,45", "point": "0,-2,0", "spot": "0,-3,0,0,0,0,60", "rect": "0,-3,0,0,0,0,1,2",
        "disk": "0,-3,0,0,0,0,1,#ffffff", "sphere": "0,-3,0,0.5,#ffffff,3",
    }  # fmt: skip
    for name, value in lights.items():
        done = run(capfd, "light", asset, f"--{name}", value, "--out", tmp_path / f"{name}.spz", "--json")
        assert done.code == 0 and done.json["verified"] and done.json["receipt"]["touched_rows"] > 1000, done


def test_a_display_picture_is_a_sky_with_a_note(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    Image.new("RGB", (16, 8), (200, 120, 60)).save(tmp_path / "dusk.png")
    done = run(capfd, "light", asset, "--hdri", tmp_path / "dusk.png", "--rotate", "40", "--out", tmp_path / "o.ply")
    assert done.code == 0 and "brighter than white is missing" in done.out


def test_the_light_is_taken_out(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "large.ply", ball(5000))
    assert run(capfd, "light", asset, "--hdri", "noon", "--exposure", "-2", "--out", tmp_path / "noon.ply").code == 0
    done = run(capfd, "delight", tmp_path / "noon.ply", "--out", tmp_path / "flat.ply")
    assert done.code == 0 and done.out.count("delight") == 1, done

    def shading(path: Path) -> float:
        pale = read(path).sh[:, 0][ball(5000).means[:, 1] > -0.7]
        return float(pale.std(0).mean())

    assert shading(tmp_path / "flat.ply") < 0.6 * shading(tmp_path / "noon.ply")


@pytest.mark.parametrize(
    "words, line",
    [
        ([], "expected a light (an environment, a sun or a lamp), got none"),
        (["--sun", "30"], "--sun: expected AZIMUTH,ELEVATION[,#RRGGBB or 2700K[,INTENSITY]], got '30'"),
        (["--sun", "30,40,red"], "--sun: expected AZIMUTH,ELEVATION"),
        (["--sun", "30,95"], "expected a sun at AZIMUTH,ELEVATION (-90 to 90), got 30,95"),
        (["--sun", "30,40,#ffffff,0"], "expected an intensity above 0, up to 1e6, got 0"),
        (["--sun", "30,40,#ffffff,-2"], "expected an intensity above 0, up to 1e6, got -2"),
        (["--sun", "nan,40"], "--sun: expected AZIMUTH,ELEVATION"),
        (["--sun", "3,40,#000000"], "colour of a light that is not black"),
        (
            ["--point", "0,0,0.2"],
            "the point light at 0,0,0.2 reaches none of 1200 Gaussians; it lies inside the object",
        ),
        (["--spot", "0,0,3,0,0,3,40"], "look to another place than its own"),
        (["--sphere", "0,0,3,0"], "sizes of a sphere light above 0"),
        (["--point", "1,2"], "--point: expected X,Y,Z[,#RRGGBB or 2700K[,INTENSITY]], got '1,2'"),
        (["--hdri", "dusk"], "--hdri: expected studio, "),
        (["--hdri", "no.hdr"], "no.hdr: no such file"),
        (["--hdri", "broken.hdr"], "broken.hdr: is not a Radiance .hdr picture"),
        (["--hdri", "black.png"], "black.png: the environment is black"),
        (["--hdri", "square.png"], "square.png: expected a lat-long picture, twice as wide as high, got 8x8"),
        (["--hdri", "ball.ply"], "ball.ply: expected an environment (.hdr, .exr, .png"),
        (["--hdri", "noon", "--source-light", "broken.hdr"], "broken.hdr: is not a Radiance .hdr picture"),
        (["--hdri", "noon", "--exposure", "99"], "expected --exposure from -10 to 10, got 99.0"),
        (["--hdri", "noon", "--mix", "0"], "expected --mix above 0, up to 1, got 0"),
        (["--hdri", "noon", "--fill", "-1"], "expected --fill from 0 to 10, got -1.0"),
        (["--sun", "0,40", "--kelvin", "100"], "expected --kelvin from 1667 to 25000, got 100"),
        (["--sun", "0,40", "--where", "x=9.."], "reaches none of 1200 Gaussians"),
    ],
)
def test_what_cannot_shine_is_one_line_and_writes_nothing(
    words: list[str], line: str, asset: Path, tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if any(word.endswith(".hdr") for word in words):
        pytest.importorskip("OpenImageIO")
    monkeypatch.chdir(tmp_path)
    Path("broken.hdr").write_bytes(b"#?RADIANCE\nnot a picture")
    Image.new("RGB", (16, 8)).save("black.png")
    Image.new("RGB", (8, 8), (9, 9, 9)).save("square.png")
    before = listing(tmp_path)
    done = run(capfd, "light", "ball.ply", *words, "--out", "out.ply")
    assert line in done.error
    assert listing(tmp_path) == before


def test_words_are_lights() -> None:
    sun = parse_sun("-30,40.5,#808080,1.5", 2.0)
    assert (sun.azimuth, sun.elevation, sun.size, sun.intensity) == (-30, 40.5, 2.0, 1.5)
    np.testing.assert_allclose(sun.color, 0.2158605, rtol=1e-5)
    rect = parse_lamp("rect", "1,2,3,4,5,6,7,8,2.5", white_of(2700))
    assert rect.position == (1, 2, 3) and rect.target == (4, 5, 6) and rect.sizes == (7, 8) and rect.intensity == 2.5
    assert rect.color[0] > rect.color[2] and len(SKIES) == 8


def test_a_broken_sky_is_one_line_to_the_end_of_the_process(asset: Path, tmp_path: Path) -> None:
    """What libraries print while the interpreter closes is seen by users, and by no test within it."""
    pytest.importorskip("OpenImageIO")
    write_sky(tmp_path / "black.hdr", SkyMap(np.zeros((4, 8, 3), np.float32), "black"))
    words = ["light", str(asset), "--hdri", str(tmp_path / "black.hdr"), "--out", str(tmp_path / "out.ply")]
    done = subprocess.run([sys.executable, "-m", "splatpainter", *words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.strip() == f"splatpainter: {tmp_path / 'black.hdr'}: the environment is black"
