"""The command line as people and programs use it: help, info, convert, render, edit, verify."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
from PIL import Image

from splatpainter import cli
from splatpainter.commands import SUMMARIES
from splatpainter.io import read, write
from tests.support.cli_scenes import (
    BOX,
    Ran,
    ball,
    listing,
    paint,
    rows_of,
    run,
    saved,
    with_bad_gaussians,
    without_camera,
)


@pytest.fixture()
def view(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Path:
    """ball.ply in the folder, and one picture of it of 96 pixels; returns the picture."""
    asset = saved(tmp_path / "ball.ply")
    assert run(capfd, "render", asset, "--out", tmp_path / "views", "--views", 1, "--size", 96).code == 0
    return tmp_path / "views" / "view_000.png"


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def process(*words: object, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "splatpainter", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, **options)


# Help


@pytest.mark.parametrize("name", SUMMARIES)
def test_help_says_what_and_how(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    output = run(capfd, name, "--help")
    assert (output.code, output.err) == (0, "")
    assert f"usage: splatpainter {name}" in output.out
    assert f"example:\n  splatpainter {name}" in output.out


def test_texts_of_options_are_broken_at_the_edge_alone(capfd: pytest.CaptureFixture[str]) -> None:
    """And not where their docstrings have line breaks."""
    text = " ".join(run(capfd, "edit", "--help").out.replace("│", " ").split())
    assert "or the view beside the picture or beside ASSET that it matches. --mask" in text
    lines = [line.strip("│ ") for line in run(capfd, "edit", "--help").out.splitlines() if line.startswith("│")]
    assert not {"picture", "at", "further."} & {*lines}, "a line of one word, where the docstring was broken"


def test_defaults_are_of_their_types() -> None:
    """What `option_parsing.parse` does not let tyro ask at each start."""
    import typeguard

    for name in SUMMARIES:
        config = getattr(cli._module(name), "Config", None) if name not in cli.DISTRIBUTIONS else None
        for option in fields(config) if config else ():
            if option.default is not MISSING:
                typeguard.check_type(option.default, get_type_hints(config)[option.name])


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_the_list_of_commands(words: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    output = run(capfd, *words)
    assert (output.code, output.err) == (0, "")
    assert all(re.search(rf"^  {name} +{re.escape(line)}$", output.out, re.M) for name, line in SUMMARIES.items())


def test_version_and_module_entry() -> None:
    output = process("--version")
    assert (output.returncode, output.stderr) == (0, "")
    assert re.fullmatch(r"splatpainter \d+\.\d+\.\d+\n", output.stdout)


@pytest.mark.parametrize("words", [["--help"], ["info"], ["info", "--json"], ["convert"], ["verify"]])
def test_light_commands_load_neither_torch_nor_numba(words: list[str], tmp_path: Path) -> None:
    files = {"info": ["ball.ply"], "convert": ["ball.ply", "out.spz"], "verify": ["ball.ply", "ball.ply"]}
    saved(tmp_path / "ball.ply")
    words = [words[0], *files.get(words[0], []), *words[1:]]
    program = (
        f"import sys\nfrom splatpainter.cli import main\ncode = main({words!r})\n"
        "print([name for name in ('torch', 'numba') if name in sys.modules], file=sys.stderr)\nsys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "[]\n")


# info and convert


def test_info_counts_gaussians_that_cannot_be_drawn(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asset = saved(tmp_path / "odd.ply", with_bad_gaussians(ball(500)))
    record = run(capfd, "info", asset, "--json").json
    assert (record["rows"], record["rows_not_drawn"], record["sh_degree"]) == (500, 4, 1)
    assert (record["format"], record["color_space"], record["antialiased"]) == ("ply", "srgb", False)
    assert record["bytes"] == asset.stat().st_size
    import hashlib

    assert record["sha256"] == hashlib.sha256(asset.read_bytes()).hexdigest()
    stored = rows_of(asset).view("<f4")[:, :3]  # x y z come first
    finite = stored[np.isfinite(stored).all(1)]
    assert np.array_equal(record["bounds"], [finite.min(0), finite.max(0)])
    text = run(capfd, "info", asset)
    assert "500 Gaussians, of which 4 cannot be drawn" in text.out and text.err == ""
    assert sum(line.startswith("problem") for line in text.out.splitlines()) == len(record["problems"]) > 0


def test_info_of_nothing_drawable(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    nowhere = replace(ball(10), means=np.full((10, 3), np.nan, np.float32))
    record = run(capfd, "info", saved(tmp_path / "none.ply", nowhere), "--json").json
    assert (record["rows_not_drawn"], record["bounds"], record["reach"]) == (10, None, None)
    assert run(capfd, "info", tmp_path / "none.ply").code == 0


def test_convert_has_the_options_of_the_formats(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asset, small = saved(tmp_path / "ball.ply"), tmp_path / "small.spz"
    options = ("--sh-degree", "0", "--spz-version", "4", "--antialiased", "yes")
    made = run(capfd, "convert", asset, small, *options, "--json").json
    assert "SH degree 1 became 0" in made["lost"] and small.read_bytes().startswith(b"NGSP")
    assert read(small).antialiased and read(small).sh_degree == 0
    made = run(capfd, "convert", asset, tmp_path / "few.sog", "--sh-palette", "64", "--json").json
    assert "at most 64 SH vectors" in made["lost"]
    for words, reason in (
        (("b.splat", "--sh-degree", "0"), "sh_degree is not an option of this format"),
        (("b.ply", "--turning"), "--turning is for OUT.html"),
        (
            ("b.html", "--spz-version", "4"),
            "spz_version is not an option of this format; it has sh_degree, antialiased",
        ),
    ):
        refused = run(capfd, "convert", asset, tmp_path / words[0], *words[1:])
        assert refused.code == 2 and reason in refused.err and not (tmp_path / words[0]).exists()
    splats = read(asset)
    opacities = splats.opacities.copy()
    opacities[:1000] = 0
    write(tmp_path / "hidden.ply", replace(splats, opacities=opacities))
    made = run(capfd, "convert", tmp_path / "hidden.ply", tmp_path / "seen.ply", "--remove-hidden", "--json").json
    assert made["lost"] == ["3,000 Gaussians became 2,000"]
    run(capfd, "convert", asset, tmp_path / "page.html", "--sh-degree", "0", "--turning")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert '"coefficients": 1,' in page and '"turning": true' in page


def test_convert_says_what_is_lost(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asset = saved(tmp_path / "ball.ply")
    exact = run(capfd, "convert", asset, tmp_path / "ball.glb", "--json").json
    assert exact["lost"] == [] and exact["output"]["rows"] == 3000
    lossy = run(capfd, "convert", asset, tmp_path / "ball.splat", "--json").json
    assert "SH degree 1 became 0" in lossy["lost"]
    assert lossy["output"]["bytes"] == 32 * 3000 == (tmp_path / "ball.splat").stat().st_size
    text = run(capfd, "convert", asset, tmp_path / "ball.spz").out
    assert "3,000 Gaussians" in text and "lost: " in text
    folder = run(capfd, "convert", asset, tmp_path / "planes" / "meta.json")
    assert folder.code == 0 and (tmp_path / "planes" / "means_l.webp").exists()
    assert not [name for name in listing(tmp_path) if "part" in name]


# render


def test_pictures_carry_their_camera(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with Image.open(view) as picture:
        stored = json.loads(picture.text["splatpainter"])  # type: ignore[attr-defined]
        assert picture.size == (96, 96)
    assert stored == json.loads(view.with_suffix(".json").read_text())
    assert stored["version"] == 1 and (stored["width"], stored["height"]) == (96, 96)
    asset = view.parent.parent / "ball.ply"
    record = run(capfd, "info", asset, "--json").json
    assert stored["asset_sha256"] == record["sha256"]
    again = asset.parent / "again"
    for camera in (view.with_suffix(".json"), view):
        done = run(capfd, "render", asset, "--out", again, "--camera", camera, "--overwrite", "--json").json
        assert done["views"][0]["width"] == 96
        assert np.array_equal(pixels(again / "view_000.png"), pixels(view))


def test_the_default_ring_frames_the_asset_upright(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Also when a fifth of the Gaussians are floaters a hundred sizes away and another fifth is haze."""
    core, some = ball(), ball(1000)
    far = replace(some, means=100 * some.means)
    haze = replace(some, means=30 * some.means, opacities=np.full(1000, 0.01, np.float32))
    asset = saved(tmp_path / "floaters.ply", core.append(far).append(haze))
    done = run(capfd, "render", asset, "--out", tmp_path, "--views", 3, "--size", 64, "--background", "#00ff00")
    assert (done.code, done.err) == (0, "")
    for k in range(3):
        picture = pixels(tmp_path / f"view_{k:03d}.png")
        asset_there = (np.abs(picture - (0, 255, 0)).max(-1) > 60)[16:48, 16:48]
        assert asset_there.all(), "the ball fills the middle"
        border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        assert (border[:, 1] > 200).mean() > 0.9, "and ends before the border"
        red = (picture[..., 0] > 150) & (picture[..., 1] < 90)
        assert red[:24].sum() > 20 and red[40:].sum() == 0, "the cap around -y is up"


def test_size_and_background_of_given_cameras(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asset, out = view.parent.parent / "ball.ply", view.parent.parent / "big"
    done = run(capfd, "render", asset, "--out", out, "--camera", view, "--size", 48, "--background", "1,0,0")
    assert done.code == 0
    small = pixels(out / "view_000.png")
    assert small.shape == (48, 48, 3) and tuple(small[0, 0]) == (255, 0, 0)
    shrunk = pixels(view).reshape(48, 2, 48, 2, 3).mean((1, 3))
    assert np.abs(small - shrunk)[16:32, 16:32].mean() < 4


def test_linear_assets_are_shown_in_display_colours(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """0.7, 0.75, 0.8 of light are 218, 225, 231 of sRGB; the edit of such a picture goes back the same way."""
    asset = saved(tmp_path / "linear.glb", replace(ball(), color_space="linear"))
    run(capfd, "render", asset, "--out", tmp_path, "--views", 1, "--size", 96, "--background", "0.5,0.5,0.5")
    picture = pixels(tmp_path / "view_000.png")
    assert np.abs(np.median(picture[40:56, 40:56], (0, 1)) - (218, 225, 231)).max() <= 2
    assert np.abs(picture[0, 0] - 128).max() <= 1
    paint(tmp_path / "view_000.png", tmp_path / "p.png", BOX, (128, 60, 60))
    done = run(capfd, "edit", asset, tmp_path / "p.png", "--out", tmp_path / "out.glb", "--json")
    assert done.code == 0
    assert done.json["receipt"]["touched_rows"] < 400, "the picture's own 8-bit rounding is not an edit"
    run(capfd, "render", tmp_path / "out.glb", "--out", tmp_path / "after", "--camera", tmp_path / "view_000.json")
    after = pixels(tmp_path / "after" / "view_000.png")
    assert np.abs(np.median(after[46:52, 42:54], (0, 1)) - (128, 60, 60)).max() < 20, "50 off without the way back"


def test_gaussians_that_cannot_be_drawn_do_not_poison_pictures(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    valid, odd = ball(), with_bad_gaussians(ball())
    for name, splats in (("whole", valid.take(odd.drawable)), ("odd", odd)):
        asset = saved(tmp_path / f"{name}.ply", splats)
        camera = ["--camera", tmp_path / "whole" / "view_000.json"] if name == "odd" else ["--views", 1, "--size", 64]
        assert run(capfd, "render", asset, "--out", tmp_path / name, *camera).code == 0
    assert np.array_equal(pixels(tmp_path / "whole" / "view_000.png"), pixels(tmp_path / "odd" / "view_000.png"))


# edit and verify


def edited(view: Path, capfd: pytest.CaptureFixture[str], *more: object, out: str = "out.ply") -> Ran:
    folder = view.parent.parent
    painted = paint(view, folder / "painted.png", BOX)
    return run(capfd, "edit", folder / "ball.ply", painted, "--out", folder / out, *more)


def test_paint_edit_verify_tamper(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = view.parent.parent
    done = edited(view, capfd)
    assert (done.code, done.err) == (0, "")
    before, after = rows_of(folder / "ball.ply"), rows_of(folder / "out.ply")
    same = (before == after[: len(before)]).all(1)
    assert 0 < (~same).sum() < 300
    receipt = json.loads((folder / "out.ply.receipt.json").read_text())
    touched = np.concatenate([np.arange(first, first + count) for first, count in receipt["touched_runs"]])
    assert set(np.flatnonzero(~same)) <= set(touched) and len(touched) == receipt["touched_rows"]
    assert len(after) == len(before) + receipt["appended_rows"] == receipt["output"]["rows"]
    assert f"{same.sum():,} of {len(before):,} Gaussians byte-identical, verified" in done.out
    assert receipt["views"][0]["psnr_after"] > receipt["views"][0]["psnr_before"] + 10
    assert {"read", "prepare", "lift", "write", "verify"} <= set(receipt["seconds"])

    assert run(capfd, "render", folder / "out.ply", "--out", folder / "after", "--camera", view).code == 0
    changed = np.abs(pixels(folder / "after" / "view_000.png") - pixels(view)).max(-1)
    x0, y0, x1, y1 = BOX
    assert (changed[y0 : y1 + 1, x0 : x1 + 1] > 60).mean() > 0.9
    changed[y0 - 3 : y1 + 4, x0 - 3 : x1 + 4] = 0
    assert changed.max() < 30

    assert run(capfd, "verify", folder / "ball.ply", folder / "out.ply").code == 0
    data = bytearray((folder / "out.ply").read_bytes())
    row = int(np.flatnonzero(same)[100])
    data[data.index(b"end_header\n") + 11 + row * before.shape[1] + 4] ^= 1  # the lowest bit of one y
    (folder / "out.ply").write_bytes(data)
    wrong = run(capfd, "verify", folder / "ball.ply", folder / "out.ply", "--json")
    assert wrong.code == 1 and wrong.err == ""
    assert not wrong.json["ok"] and any(f"does not list: {row}" in problem for problem in wrong.json["problems"])
    assert "NOT verified" in run(capfd, "verify", folder / "ball.ply", folder / "out.ply").out


def test_verify_without_a_receipt_counts(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = view.parent.parent
    edited(view, capfd)
    (folder / "out.ply.receipt.json").unlink()
    verified = run(capfd, "verify", folder / "ball.ply", folder / "out.ply", "--json")
    assert verified.code == 0 and verified.json["receipt"] is None and verified.json["changed"] > 0
    backwards = run(capfd, "verify", folder / "out.ply", folder / "ball.ply")
    assert backwards.code == 1 and "rows are missing" in backwards.out


def test_json_is_all_there_is_on_stdout(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    done = edited(view, capfd, "--json", "--receipt", view.parent.parent / "r.json")
    assert done.err == ""
    receipt = json.loads((view.parent.parent / "r.json").read_text())
    assert done.json["receipt"] == receipt and done.json["verified"] is True
    expected = {
        "asset", "output", "mode", "method", "preset", "touched_rows", "appended_rows", "removed_rows",
        "untouched_sha256_before", "untouched_sha256_after", "views", "seconds",
    }  # fmt: skip
    assert expected <= set(receipt)
    assert receipt["untouched_sha256_before"] == receipt["untouched_sha256_after"]


@pytest.mark.parametrize("name", ["out.compressed.ply", "out.splat", "out.spz", "out.sog", "out.glb", "out/meta.json"])
def test_formats_that_round_say_so_and_still_verify(name: str, view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    done = edited(view, capfd, "--json", out=name)
    assert (done.code, done.err) == (0, "")
    receipt = done.json["receipt"]
    assert "compared with the original converted to" in receipt["note"]
    again = "rounded anew" in receipt["note"]
    assert again == (receipt["touched_rows"] > 300), "Gaussians that the format rounds anew are listed and explained"
    folder = view.parent.parent
    verified = run(capfd, "verify", folder / "ball.ply", folder / name, "--json")
    assert verified.code == 0 and verified.json["ok"] and verified.json["receipt"] is not None
    assert verified.json["same"] == done.json["same_rows"] >= 3000 - receipt["touched_rows"]


def test_in_place_only_with_overwrite(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = view.parent.parent
    original = (folder / "ball.ply").read_bytes()
    assert "is the input itself" in edited(view, capfd, out="ball.ply").error
    assert (folder / "ball.ply").read_bytes() == original
    assert edited(view, capfd, "--overwrite", out="ball.ply").code == 0
    (folder / "kept.ply").write_bytes(original)
    verified = run(capfd, "verify", folder / "kept.ply", folder / "ball.ply", "--json").json
    assert verified["ok"] and verified["changed"] > 0 and verified["receipt"] is not None


def test_a_camera_of_another_asset_warns(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = view.parent.parent
    edited(view, capfd)
    other = run(
        capfd, "edit", folder / "out.ply", folder / "painted.png", "--out", folder / "two.ply", "--mode", "global"
    )
    assert other.code == 0
    assert other.err.count("\n") == 1 and "painted.png: was rendered from another asset" in other.err


def test_cameras_and_masks_in_the_order_of_the_pictures(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asset = saved(tmp_path / "ball.ply")
    run(capfd, "render", asset, "--out", tmp_path, "--views", 2, "--size", 96)
    pictures, masks, cameras = [], [], []
    for k, box in enumerate([(30, 40, 44, 50), (50, 40, 64, 50)]):
        source = tmp_path / f"view_{k:03d}.png"
        pictures.append(without_camera(paint(source, tmp_path / f"c{k}.png", box), tmp_path / f"p{k}.png"))
        mask = np.zeros((96, 96), np.uint8)
        mask[box[1] : box[3], box[0] : box[2]] = 255
        Image.fromarray(mask).save(tmp_path / f"m{k}.png")
        masks.append(tmp_path / f"m{k}.png")
        cameras.append(source.with_suffix(".json"))
    out = tmp_path / "out.ply"
    done = run(capfd, "edit", asset, *pictures, "--out", out, "--camera", *cameras, "--mask", *masks, "--json")
    assert done.code == 0 and len(done.json["receipt"]["views"]) == 2
    assert run(capfd, "render", out, "--out", tmp_path / "after", "--camera", *cameras).code == 0
    green = [pixels(tmp_path / "after" / f"view_{k:03d}.png")[42:48] for k in range(2)]
    green = [(part[..., 1] > 120) & (part[..., 0] < 90) for part in green]
    assert green[0][:, 32:42].mean() > 0.9 and green[0][:, 50:62].mean() < 0.1
    assert green[1][:, 52:62].mean() > 0.9 and green[1][:, 32:42].mean() < 0.1


def test_a_resized_picture_edits_the_same_place(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = view.parent.parent
    plain = edited(view, capfd, "--json").json["receipt"]["touched_runs"]
    for factor in (2, 0.5):
        with Image.open(folder / "painted.png") as picture:
            side = round(96 * factor)
            picture.resize((side, side), Image.Resampling.BICUBIC).save(folder / "resized.png")
        done = run(
            capfd, "edit", folder / "ball.ply", folder / "resized.png", "--camera", view, "--out", folder / "r.ply",
            "--overwrite", "--json",
        )  # fmt: skip
        assert done.code == 0
        note = (
            "a larger render of its view of 96x96"
            if factor > 1
            else f"resampled from {side}x{side} to its camera's 96x96"
        )
        assert note in done.json["notes"][0]
        runs = done.json["receipt"]["touched_runs"]
        first, second = ({r for a, n in some for r in range(a, a + n)} for some in (plain, runs))
        assert len(second) < 2 * len(first) and len(first & second) > 0.6 * len(first)


def test_global_mode_changes_what_no_picture_shows(view: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = view.parent.parent
    Image.fromarray((pixels(view) // 2).astype(np.uint8)).save(folder / "dark.png")
    done = run(
        capfd, "edit", folder / "ball.ply", folder / "dark.png", "--camera", view, "--mode", "global", "--out",
        folder / "dark.ply", "--json",
    )  # fmt: skip
    assert done.code == 0 and done.json["receipt"]["touched_rows"] > 2900


# Things that go wrong elsewhere


def test_a_fault_of_ours_is_one_line_and_debug_shows_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from splatpainter.commands import info

    def broken(config: object) -> None:
        raise TypeError("two\nlines")

    monkeypatch.setattr(info, "run", broken)
    done = run(capfd, "info", tmp_path)
    assert done.code == cli.FAULT and done.err.count("\n") == 1 and "TypeError: two lines" in done.err
    monkeypatch.setenv(cli.DEBUG, "1")
    with pytest.raises(TypeError):
        cli.main(["info", str(tmp_path)])


@pytest.mark.shared
@pytest.mark.parametrize(
    "name",
    [
        "angel.sog", "biker.compressed.ply", "biker.v4.spz", "massa.ply", "massa.splat", "narcissus.sog",
        "playbot_lod3", "playbot_lod3.compressed.ply", "playbot_lod3.l1.ksplat", "playbot_lod3.ply",
        "playbot_lod3.v2.spz", "playbot_lod3.v3.spz", "playbot_lod4.glb", "playbot_lod4.l0.ksplat",
        "playbot_lod4_sh3.ply", "st-peter.sog",
    ],
)  # fmt: skip
def test_every_real_asset_is_edited_in_its_own_format(
    name: str, shared: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    asset = shared / "data" / "splats" / name
    if not asset.exists():
        pytest.skip(f"no real asset: {asset}")
    assert run(capfd, "render", asset, "--out", tmp_path, "--views", 1, "--size", 128).code == 0
    painted = paint(tmp_path / "view_000.png", tmp_path / "painted.png", (61, 60, 68, 66))
    out = tmp_path / (f"{name}.ply" if name.endswith(".ksplat") else name)
    out = out / "meta.json" if asset.is_dir() else out
    done = run(capfd, "edit", asset, painted, "--out", out, "--json")
    assert (done.code, done.err) == (0, "")
    receipt = done.json["receipt"]
    assert receipt["views"][0]["psnr_after"] > receipt["views"][0]["psnr_before"] + 5
    assert receipt["views"][0]["psnr_outside"] > 38
    assert run(capfd, "verify", asset, out).code == 0
