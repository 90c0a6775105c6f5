"""Pictures given by hand meet the gate: wrong ones cost nothing, paint passes, `--correct` and `--force` go on."""

from __future__ import annotations

import io
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.gatekeeper import picture_gate
from splatpainter.gatekeeper.mistaken_pictures import Explanation
from splatpainter.splats import SH_C0
from tests.support.cli_scenes import BOX, Capture, ball, ball_and_painted_view, refused, run, saved, without_camera


def pixels_of(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def saved_beside(view: Path, name: str, pixels: np.ndarray, **settings: object) -> Path:
    """With the camera of the view beside it."""
    target = view.parent / name
    Image.fromarray(np.ascontiguousarray(pixels)).save(target, **settings)  # type: ignore[arg-type]
    (target.parent / f"{target.stem}.json").write_bytes((view.parent / "views" / "view_000.json").read_bytes())
    return target


def linear(pixels: np.ndarray) -> np.ndarray:
    colors = pixels / 255
    light = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return (light * 255).round().astype(np.uint8)


def test_a_wrong_picture_is_refused_before_anything_is_spent(tmp_path: Path, capfd: Capture) -> None:
    view = ball_and_painted_view(tmp_path, capfd)
    pixels = pixels_of(view)
    line = refused(capfd, tmp_path, saved_beside(view, "flipped.png", pixels[::-1]))
    assert "most likely it is mirrored from top to bottom (usual reasons: recompressed, another gamma" in line
    assert "--mask M.png" in line and "--correct" in line and "--force" in line and "--mode global" not in line
    line = refused(capfd, tmp_path, saved_beside(view, "linear.tif", linear(pixels)))
    assert "linear light without a profile" in line and "--mode global takes it as a look" in line
    noise = np.random.default_rng(0).integers(0, 256, pixels.shape, np.uint8)
    assert "of another asset, another view or another camera" in refused(
        capfd, tmp_path, saved_beside(view, "noise.png", noise)
    )


def test_force_and_mask_and_global_pass(tmp_path: Path, capfd: Capture) -> None:
    view = ball_and_painted_view(tmp_path, capfd)
    picture = saved_beside(view, "linear.png", linear(pixels_of(view)))
    mask = np.zeros(pixels_of(view).shape[:2], np.uint8)
    mask[BOX[1] : BOX[3], BOX[0] : BOX[2]] = 255
    Image.fromarray(mask).save(tmp_path / "m.png")
    for more in (["--force"], ["--mode", "global"], ["--mask", tmp_path / "m.png"]):
        done = run(capfd, "edit", tmp_path / "ball.ply", picture, "--out", tmp_path / "o.ply", "--overwrite", *more)
        assert done.code == 0, done.err
        assert ("painted with as it is" in done.err) == (more == ["--force"])


@pytest.mark.parametrize("name", ["linear.png", "mirrored.jpg"])
def test_correct_paints_what_was_painted(name: str, tmp_path: Path, capfd: Capture) -> None:
    view = ball_and_painted_view(tmp_path, capfd)
    pixels = pixels_of(view)
    pixels = linear(pixels) if name == "linear.png" else pixels[::-1]
    settings = {"quality": 97, "subsampling": 0} if name.endswith("jpg") else {}
    picture = saved_beside(view, name, pixels, **settings)
    done = run(capfd, "edit", tmp_path / "ball.ply", picture, "--out", tmp_path / "o.ply", "--correct")
    assert done.code == 0, done.err
    assert "put right: it was" in done.out
    plain = run(capfd, "edit", tmp_path / "ball.ply", view, "--out", tmp_path / "p.ply", "--json")
    corrected = run(
        capfd, "edit", tmp_path / "ball.ply", picture, "--out", tmp_path / "o.ply", "--correct", "--json", "--overwrite"
    )
    one, other = (ran.json["receipt"]["touched_rows"] for ran in (plain, corrected))
    assert 0.6 * one < other < 3 * one  # the gatekeeper softens the edge of a stroke of 9 pixels by four


def test_a_larger_picture_that_lies_beside_its_view_is_put_right(tmp_path: Path, capfd: Capture) -> None:
    """It was compared with a render of another size, and said "operands could not be broadcast"."""
    splats = ball()
    splats.sh[:, 0] = np.random.default_rng(0).uniform(-0.4, 0.4, (len(splats), 3)) / SH_C0  # detail everywhere
    asset = saved(tmp_path / "spots.ply", splats)
    assert run(capfd, "render", asset, "--out", tmp_path / "views", "--views", 1, "--size", 160).code == 0
    view = Image.open(tmp_path / "views" / "view_000.png").convert("RGB")
    view.paste((20, 200, 60), (74, 74, 86, 86))
    pixels = np.asarray(view.resize((240, 240), Image.Resampling.BICUBIC)).copy()
    pixels[..., 0] = np.roll(pixels[..., 0], 4, 1)
    picture = saved_beside(tmp_path / "view.png", "apart.png", pixels)
    done = run(capfd, "edit", asset, picture, "--out", tmp_path / "o.ply", "--correct")
    assert done.code == 0, done.err
    assert "put right: it was of colours that lie beside each other" in done.out


def test_compression_is_no_paint(tmp_path: Path, capfd: Capture) -> None:
    view = ball_and_painted_view(tmp_path, capfd)
    clean = pixels_of(tmp_path / "views" / "view_000.png")
    for name, settings, words in (
        ("a.jpg", {"quality": 60}, "JPEG of quality 60"),
        ("b.webp", {"quality": 20}, "lossy WebP"),
    ):
        line = refused(capfd, tmp_path, saved_beside(view, name, clean, **settings))
        assert f"nothing was painted: it differs from its view only as {words} does" in line
    file = io.BytesIO()
    Image.fromarray(clean).save(file, "JPEG", quality=60)
    line = refused(capfd, tmp_path, saved_beside(view, "c.png", np.asarray(Image.open(file))))
    assert "only as JPEG of quality 60 does" in line


def test_options_that_exclude_each_other(tmp_path: Path, capfd: Capture) -> None:
    view = ball_and_painted_view(tmp_path, capfd)
    assert "expected one of --correct and --force" in refused(capfd, tmp_path, view, "--correct", "--force")


def test_a_picture_of_another_view_says_so(tmp_path: Path, capfd: Capture) -> None:
    splats = ball()
    splats.sh[:, 0] = 0.45 * np.sin(7 * splats.means) / SH_C0  # another face on each side
    splats.means[:, 1] *= 1.6  # and another outline
    asset, camera = saved(tmp_path / "ball.ply", splats), tmp_path / "views" / "view_000.json"
    for folder, elevation in (("views", 15), ("above", 80)):
        ring = ["--views", 1, "--size", 96, "--elevation", elevation]
        assert run(capfd, "render", asset, "--out", tmp_path / folder, *ring).code == 0
    other = tmp_path / "above" / "view_000.png"
    line = refused(capfd, tmp_path, other, "--camera", camera)
    assert "of another view: it has a camera of its own (leave --camera out)" in line
    line = refused(capfd, tmp_path, without_camera(other, tmp_path / "above" / "lost.png"), "--camera", camera)
    assert f"of another view: it is like view_000.png (--camera {other})" in line


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_filters_are_looked_for_beside_what_explains_the_picture(
    threads: int, tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", str(threads))
    view = ball_and_painted_view(tmp_path, capfd)
    lookers: list[str] = []
    before = picture_gate.filtered

    def noted(*pictures: np.ndarray) -> Explanation | None:
        lookers.append(threading.current_thread().name)
        return before(*pictures)

    monkeypatch.setattr(picture_gate, "filtered", noted)
    assert run(capfd, "edit", tmp_path / "ball.ply", view, "--out", tmp_path / "o.ply").code == 0
    assert lookers == [threading.current_thread().name if threads == 1 else "splatpainter beside"]
    # What it finds is said, however many threads looked for it; a mistake that explains the picture comes first.
    explanation = Explanation("filter", "blurred", 0.1, 0.0)
    monkeypatch.setattr(picture_gate, "filtered", lambda *pictures: explanation)
    assert "most likely it is blurred" in refused(capfd, tmp_path, view)
    line = refused(capfd, tmp_path, saved_beside(view, "flipped.png", pixels_of(view)[::-1]))
    assert "mirrored from top to bottom" in line and "blurred" not in line


def test_filters_are_looked_for_on_the_views_ground(
    tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = ball_and_painted_view(tmp_path, capfd)
    pixels = pixels_of(view).copy()
    before = pixels_of(tmp_path / "views" / "view_000.png")
    pixels[(before == before[0, 0]).all(-1)] = 255
    picture = saved_beside(view, "white.png", pixels)
    seen: list[np.ndarray] = []

    def blurred(*pictures: np.ndarray) -> Explanation:
        seen.append(pictures[0])
        return Explanation("filter", "blurred", 0.1, 0.0)

    monkeypatch.setattr(picture_gate, "filtered", blurred)
    assert "most likely it is blurred" in refused(capfd, tmp_path, picture)
    assert len(seen) == 1
    np.testing.assert_allclose(seen[0][0, 0], before[0, 0] / 255, atol=1e-3, err_msg="the view's own ground")


def test_a_filter_beside_what_may_be_meant_is_not_said(
    tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = ball_and_painted_view(tmp_path, capfd)
    meant = Explanation("look", "like another look of it", 0.5, 0.5)
    assert meant.may_be_meant
    monkeypatch.setattr(picture_gate, "explain", lambda *_: meant)
    monkeypatch.setattr(picture_gate, "filtered", lambda *_: Explanation("filter", "blurred", 0.1, 0.0))
    done = run(capfd, "edit", tmp_path / "ball.ply", view, "--out", tmp_path / "o.ply")
    assert done.code == 0 and "it looks like another look of it" in done.err and "blurred" not in done.err


@pytest.mark.parametrize("power", [4, 12])
def test_it_is_said_how_a_vignette_is_taken_back(power: int, tmp_path: Path, capfd: Capture) -> None:
    """One that reaches half of the asset is refused, one of the corners alone is remarked."""
    splats = ball()
    splats.sh[:, 0] = np.random.default_rng(0).uniform(-0.4, 0.4, (len(splats), 3)) / SH_C0  # detail everywhere
    asset, grey = saved(tmp_path / "spots.ply", splats), "0.5,0.5,0.5"
    shape = ["--views", 1, "--size", 160, "--background", grey]
    assert run(capfd, "render", asset, "--out", tmp_path / "views", *shape).code == 0
    view = Image.open(tmp_path / "views" / "view_000.png").convert("RGB")
    view.paste((20, 200, 60), (74, 74, 86, 86))
    pixels = np.asarray(view)
    radius = np.hypot(*np.mgrid[-79.5:80, -79.5:80])[..., None] / np.hypot(80, 80)
    plain = saved_beside(tmp_path / "view.png", "plain.png", pixels)
    picture = saved_beside(
        tmp_path / "view.png", "dark.png", (pixels * (1 - 0.8 * radius**power)).round().astype(np.uint8)
    )
    done = run(capfd, "edit", asset, picture, "--out", tmp_path / "o.ply")
    assert done.code == (2 if power == 4 else 0) and "towards its corners (a vignette)" in done.err
    advice = "--correct puts it right" if power == 4 else "--correct takes that back and paints what is left"
    assert advice in done.err
    touched = []
    for one, more in ((plain, []), (picture, ["--correct"])):
        done = run(capfd, "edit", asset, one, "--out", tmp_path / f"{one.stem}.ply", "--json", "--overwrite", *more)
        assert done.code == 0, done.err
        touched.append(done.json["receipt"]["touched_rows"])
    assert 0.6 * touched[0] < touched[1] < 3 * touched[0]
