"""Pictures from elsewhere: their camera is found, moves are taken back, changes and side effects are told apart."""

from __future__ import annotations

import contextlib
import io
import json
import time
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.color import srgb_to_linear
from splatpainter.gatekeeper import crop_search
from splatpainter.gatekeeper.borders import BORDER_NOTE
from splatpainter.image_files import CAMERA_KEYWORD, encode_exr, to_uint8
from splatpainter.lights.sky_maps import SkyMap, write_sky
from splatpainter.pictures.lost_transparency import GROUND_NOTE
from splatpainter.rendering import render
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.server.uploads.watched_folder import saved_picture
from tests.pictures.test_layered_files import planes_of, psd
from tests.support.studio_scenes import Live, ball, live_with_folder, view, wire


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live_with_folder(tmp_path) as served:
        yield served


def fetch(studio: Live, blob: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{blob}").content)))


def shot(size: int = 96, angle: float = 0) -> np.ndarray:
    return np.clip(render(ball(), view(size, angle)).colors[0], 0, 1)


def painted(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    out, mask = image.copy(), np.zeros(image.shape[:2], bool)
    mask[40:56, 30:60] = True
    out[mask] = (0.9, 0.8, 0.1)
    return out, mask


def test_a_painted_export_comes_back_with_its_camera_and_mask(studio: Live) -> None:
    given = studio.post("view.export", camera=wire(view()))
    image, mask = painted(fetch(studio, given["picture"]) / 255)
    checked = studio.post("picture.check", picture=studio.send(png_bytes(image, view())))
    assert checked["camera_source"] == "chunk" and checked["warnings"] == [] and checked["shift"] == [0, 0]
    assert np.allclose(checked["camera"]["world_to_camera"], view().world_to_camera)
    seen = fetch(studio, checked["mask"]) > 127
    assert (seen & mask).sum() > 0.95 * mask.sum() and (seen & ~mask).sum() < 0.2 * mask.sum()
    assert checked["share"] == pytest.approx(seen.mean())


def test_the_flattened_picture_of_a_psd_is_painted_with(studio: Live, tmp_path: Path) -> None:
    studio.post("view.export", camera=wire(view()))
    image, mask = painted(shot())
    levels = (image * 255).round().astype(np.uint8)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("mergedimage.png", png_bytes(image))
    for data, name in ((psd(planes_of(levels)), "a.psd"), (file.getvalue(), "a.kra")):
        checked = studio.post("picture.check", picture=studio.send(data, name))
        assert checked["camera_source"] == "export" and checked["warnings"] == []
        seen = fetch(studio, checked["mask"]) > 127
        assert (seen & mask).sum() > 0.95 * mask.sum() and (seen & ~mask).sum() < 0.2 * mask.sum()


def test_a_grade_that_lifts_the_background_is_no_ground(studio: Live) -> None:
    """Lower contrast makes grey of black; the asset changed as well."""
    image = np.clip(render(ball(), view()).colors[0], 0, 1)
    file = io.BytesIO()
    Image.fromarray(((0.05 + 0.9 * image) * 255).round().astype(np.uint8)).save(file, "PNG")
    checked = studio.post("picture.check", picture=studio.send(file.getvalue()), camera=wire(view()))
    assert GROUND_NOTE not in checked["notes"]
    assert any("most likely it is" in warning["message"] for warning in checked["warnings"])


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("bar", [10, 24])  # also over all of the background
def test_a_border_around_a_picture_is_no_paint(studio: Live, bar: int, scale: int) -> None:
    larger = view(96 * scale)
    image = np.clip(render(ball(), larger).colors[0], 0, 1)
    mask = np.zeros(image.shape[:2], bool)
    mask[40 * scale : 56 * scale, 36 * scale : 60 * scale] = True
    image[mask] = (0.9, 0.8, 0.1)
    rim = np.ones_like(mask)
    rim[bar * scale : -bar * scale] = False  # over parts of the ball
    image[rim] = 1
    file = io.BytesIO()
    Image.fromarray((image * 255).round().astype(np.uint8)).save(file, "PNG")
    checked = studio.post("picture.check", picture=studio.send(file.getvalue()), camera=wire(view()))
    assert BORDER_NOTE in checked["notes"] and checked["warnings"] == []
    seen = fetch(studio, checked["mask"]) > 127
    assert (seen & mask).sum() > 0.95 * mask.sum() and not (seen & rim).any()


@pytest.mark.parametrize(("color", "is_certain"), [(0.0, True), (0.5, False)])
def test_a_strip_along_one_side_is_left_out_or_pointed_at(studio: Live, color: float, is_certain: bool) -> None:
    """Black: a film's bar; a grey that fills the lower side of an asset without a background may be meant."""
    near = view(96)
    near = replace(near, fx=near.fx * 2.5, fy=near.fy * 2.5)
    image, mask = painted(np.clip(render(ball(), near).colors[0], 0, 1))
    image[-20:] = color
    blob = studio.send(png_bytes(image))
    checked = studio.post("picture.check", picture=blob, camera=wire(near))
    seen = fetch(studio, checked["mask"]) > 127
    assert seen[mask].mean() > 0.95 and (BORDER_NOTE in checked["notes"]) == is_certain
    assert not seen[-20:].any() if is_certain else seen[-20:].mean() > 0.9
    pointed = [one for one in checked["warnings"] if one["message"].startswith("One side of the picture")]
    assert bool(pointed) != is_certain
    assert is_certain or (fetch(studio, pointed[0]["picture"])[-20:, :, 3] > 0).all()


@pytest.mark.parametrize("ending", ["PNG", "JPEG"])
@pytest.mark.parametrize("scale", [1, 2])
def test_a_ground_that_a_program_laid_behind_the_picture_is_no_paint(studio: Live, ending: str, scale: int) -> None:
    larger = view(96 * scale)
    drawn = render(ball(), larger)
    image, cover = np.clip(drawn.colors[0], 0, 1), drawn.alphas[0]
    flat = image + (1 - cover) * (1 - np.array(larger.background))
    mask = np.zeros(image.shape[:2], bool)
    mask[40 * scale : 56 * scale, 36 * scale : 60 * scale] = True
    flat[mask] = (0.9, 0.8, 0.1)
    file = io.BytesIO()
    Image.fromarray((flat.clip(0, 1) * 255).round().astype(np.uint8)).save(file, ending, quality=95)
    checked = studio.post("picture.check", picture=studio.send(file.getvalue()), camera=wire(view()))
    assert GROUND_NOTE in checked["notes"] and checked["warnings"] == []
    seen, near = fetch(studio, checked["mask"]) > 127, np.zeros_like(mask)
    near[32 * scale : 64 * scale, 32 * scale : 64 * scale] = True  # the dab's blocks of a JPEG
    assert (seen & mask).sum() > 0.95 * mask.sum() and (seen & ~near).sum() < 0.1 * mask.sum()
    # What is painted with has the view's background, too.
    picture = fetch(studio, checked["picture"])[..., :3] / 255
    assert np.abs(picture - image)[~mask & ~seen].mean() < 0.02


def test_a_picture_that_differs_everywhere_is_explained(studio: Live, tmp_path: Path) -> None:
    mirrored = png_bytes(np.ascontiguousarray(shot()[::-1]))
    checked = studio.post("picture.check", picture=studio.send(mirrored), camera=wire(view()))
    assert any("mirrored from top to bottom" in warning["message"] for warning in checked["warnings"])
    file = io.BytesIO()
    Image.fromarray((shot() * 255).round().astype(np.uint8)).save(file, "JPEG", quality=40)
    checked = studio.post("picture.check", picture=studio.send(file.getvalue()), camera=wire(view()))
    assert checked["share"] == 0, "what JPEG did is no paint"


def test_cameras_are_found_in_the_sidecar_the_exports_and_by_resemblance(studio: Live, tmp_path: Path) -> None:
    for angle in (0, 90, 180):
        studio.post("view.export", camera=wire(view(96, angle)), name=f"from {angle}", to="folder")
    assert sorted(p.name for p in (tmp_path / "shared").iterdir())[:2] == ["from 0.json", "from 0.png"]
    image, _ = painted(shot(96, 90))
    checked = studio.post("picture.check", picture=studio.send(png_bytes(image), "anything.png"))
    assert checked["camera_source"] == "export" and np.allclose(
        checked["camera"]["world_to_camera"], view(96, 90).world_to_camera
    )
    checked = studio.post("picture.check", picture=studio.send(png_bytes(image)), name="from 180.jpg")
    assert checked["camera_source"] == "sidecar"
    assert np.allclose(checked["camera"]["world_to_camera"], view(96, 180).world_to_camera)
    (tmp_path / "shared" / "from 0.json").unlink()
    checked = studio.post("picture.check", picture=studio.send(png_bytes(image)), name="from 0.png")
    assert checked["camera_source"] == "export" and np.allclose(
        checked["camera"]["world_to_camera"], view().world_to_camera
    )
    noise = np.random.default_rng(0).uniform(size=(96, 96, 3))
    lost = studio.http.post("/api/do/picture.check", json={"picture": studio.send(png_bytes(noise))})
    assert lost.status_code == 400 and "go to its view" in lost.json()["error"]["hint"]
    given = studio.post("picture.check", picture=studio.send(png_bytes(noise)), camera=wire(view()))
    assert given["camera_source"] == "given" and "use it as a global edit" in given["warnings"][0]["message"]


def test_resized_and_moved_pictures_are_put_straight(studio: Live) -> None:
    image, mask = painted(shot())
    big = Image.fromarray((image * 255).astype(np.uint8)).resize((240, 240), Image.Resampling.BICUBIC)
    file = io.BytesIO()
    big.save(file, "PNG")
    checked = studio.post("picture.check", picture=studio.send(file.getvalue()), camera=wire(view()))
    assert checked["notes"] == ["240x240: a larger render of its view of 96x96"] and checked["warnings"] == []
    assert fetch(studio, checked["picture"]).shape == (240, 240, 3) and checked["camera"]["width"] == 240
    large = np.asarray(Image.fromarray(mask).resize((240, 240)))
    seen = fetch(studio, checked["mask"]) > 127
    assert (seen & large).sum() > 0.95 * large.sum() and (seen & ~large).mean() < 0.03
    views = [{key: checked[key] for key in ("camera", "picture", "mask")}]
    assert studio.post("edit", kind="picture", views=views, method="lift")["layer"]["gaussians_appended"] > 0
    studio.post("undo")
    rolled = np.roll(image, (2, -3), (0, 1))
    checked = studio.post("picture.check", picture=studio.send(png_bytes(rolled)), camera=wire(view()))
    assert checked["shift"] == [-3, 2]
    seen = fetch(studio, checked["mask"]) > 127
    assert (seen & mask).sum() > 0.9 * mask.sum() and (seen & ~mask).mean() < 0.03
    wide = studio.http.post(
        "/api/do/picture.check",
        json={"picture": studio.send(png_bytes(image[:60, ::-1])), "camera": wire(view())},
    )
    assert wide.json()["error"]["hint"] == "resize without cropping"


@pytest.mark.parametrize("scale", [1, 2])
def test_a_part_of_a_view_is_put_where_it_was_cut_out(studio: Live, scale: int) -> None:
    image, mask = painted(shot(192))
    part = image[31:140, 20:171]
    file = io.BytesIO()
    cut = Image.fromarray((part * 255).astype(np.uint8))
    cut.resize((scale * cut.width, scale * cut.height), Image.Resampling.BICUBIC).save(file, "PNG")
    checked = studio.post("picture.check", picture=studio.send(file.getvalue()), camera=wire(view(192)))
    assert checked["notes"][-1] == "a part of its view: 151x109 at 20, 31; the rest is unchanged"
    back = fetch(studio, checked["picture"]) / 255
    assert back.shape == (192, 192, 3) and np.abs(back - image).mean() < 0.01
    seen = fetch(studio, checked["mask"]) > 127
    assert (seen & mask).sum() > 0.95 * mask.sum() and not seen[:25].any() and not seen[:, 177:].any()
    lost = studio.http.post("/api/do/picture.check", json={"picture": studio.send(file.getvalue())})
    assert "matches no exported view" in lost.json()["error"]["message"]
    for angle in (90, 0):
        studio.post("view.export", camera=wire(view(192, angle)), name=f"from {angle}")
    recognised = studio.post("picture.check", picture=studio.send(file.getvalue()))
    assert recognised["camera_source"] == "export" and recognised["notes"] == checked["notes"]
    assert np.allclose(recognised["camera"]["world_to_camera"], view(192).world_to_camera)


def test_parts_are_found_where_much_was_painted_over_and_not_where_nothing_agrees() -> None:
    rng = np.random.default_rng(5)
    full = shot(400)
    cut = full[87:287, 61:361].copy()
    cut[50:120, 90:160] = rng.uniform(size=(70, 70, 3))  # what was painted, busier than all the rest
    cut[120:, 90:180] = 0.5
    crop = crop_search.find_crop(cut, full)
    assert crop is not None and (crop.x, crop.y, crop.width, crop.height) == (61, 87, 300, 200)
    assert np.array_equal(full[crop.window].shape, cut.shape)
    noisy = np.clip(full[13:213, 61:361] + rng.normal(0, 0.01, (200, 300, 3)), 0, 1)
    crop = crop_search.find_crop(noisy, full)
    assert crop is not None and (crop.x, crop.y) == (61, 13) and 0 < crop.error < 0.02
    assert crop_search.find_crop(rng.uniform(size=(200, 300, 3)), full) is None
    assert crop_search.find_crop(full[:30, :30], full) is None  # bare background
    assert crop_search.find_crop(shot(400, 180)[87:287, 61:361], full) is None
    assert crop_search.find_crop(np.zeros((500, 300, 3)), full) is None  # larger than the view
    assert crop_search.error_at(full, full) == 0


def test_a_part_of_the_views_own_shape_is_no_smaller_copy(studio: Live) -> None:
    image = shot(192)
    checked = studio.post(
        "picture.check", picture=studio.send(png_bytes(image[40:136, 60:156])), camera=wire(view(192))
    )
    assert checked["notes"] == ["a part of its view: 96x96 at 60, 40; the rest is unchanged"]
    assert checked["share"] < 0.01
    small = Image.fromarray((image * 255).astype(np.uint8)).resize((96, 96), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    small.save(file, "PNG")
    checked = studio.post("picture.check", picture=studio.send(file.getvalue()), camera=wire(view(192)))
    assert checked["notes"] == ["resampled from 96x96 to its camera's 192x192"]


def test_side_effects_outside_the_edit_are_shown(studio: Live) -> None:
    image, mask = painted(shot())
    drifted = image.copy()
    drifted[:, :48] = np.where(mask[:, :48, None], image[:, :48], image[:, :48] + 3 / 255)
    checked = studio.post("picture.check", picture=studio.send(png_bytes(drifted)), camera=wire(view()))
    assert "outside the edit" in checked["warnings"][0]["message"]
    red = fetch(studio, checked["warnings"][0]["picture"])
    assert red.shape == (96, 96, 4) and red[10, 10, 3] > 0 and red[10, 90, 3] == 0


def test_the_threshold_moves_the_mask(studio: Live) -> None:
    image = shot()
    image[20:40, 20:40] = np.clip(image[20:40, 20:40] + 0.1, 0, 1)
    picture = studio.send(png_bytes(image))
    shares = [
        studio.post("picture.check", picture=picture, camera=wire(view()), threshold=t)["share"] for t in (0.01, 0.2)
    ]
    assert shares[0] > 0.03 and shares[1] == 0


def test_a_picture_of_another_asset_is_warned_of(studio: Live) -> None:
    from dataclasses import replace

    image, _ = painted(shot())
    other = replace(view(), asset_sha256="0" * 64)
    checked = studio.post("picture.check", picture=studio.send(png_bytes(image, other)))
    assert "another asset" in checked["warnings"][0]["message"]


@pytest.mark.parametrize(("right", "down"), [(0, 0), (1, 0), (-2, 3), (3, -3)])
def test_whole_pixel_moves_are_measured(right: int, down: int) -> None:
    image, _ = painted(shot())
    assert crop_search.find_shift(np.roll(image, (down, right), (0, 1)), shot()) == (right, down)
    back = crop_search.undo_shift(np.roll(image, (down, right), (0, 1)), shot(), right, down)
    assert np.array_equal(back[8:-8, 8:-8], image[8:-8, 8:-8])


def test_a_regraded_or_foreign_picture_is_not_taken_for_a_moved_one() -> None:
    assert crop_search.find_shift(shot() ** 2, shot()) == (0, 0)
    assert crop_search.find_shift(np.random.default_rng(0).uniform(size=(96, 96, 3)), shot()) == (0, 0)


def test_saved_pictures_are_offered_once_and_whole(studio: Live, tmp_path: Path) -> None:
    shared, served = tmp_path / "shared", studio.studio
    studio.post("view.export", camera=wire(view()), name="export", to="folder")
    assert saved_picture(served, "export.png") is None  # the studio's own writing
    data = png_bytes(painted(shot())[0], view())
    (shared / "export.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="export.png: damaged picture"):
        saved_picture(served, "export.png")  # half a file
    (shared / "export.png").write_bytes(data)
    blob = saved_picture(served, "export.png")
    assert blob is not None and blob.path.read_bytes() == data
    assert saved_picture(served, "export.png") is None  # offered before
    (shared / "page.png").write_bytes(b"<html>")
    (shared / "rows.splat").write_bytes(b"\1" * 32)
    for name in ("rows.splat", "../own.splatproj"):
        assert saved_picture(served, name) is None
    with pytest.raises(ValueError, match="page.png: expected a picture"):
        saved_picture(served, "page.png")
    with pytest.raises(FileNotFoundError):
        saved_picture(served, "missing.png")


def test_a_picture_saved_into_a_folder_of_the_folder(studio: Live, tmp_path: Path) -> None:
    shared, served = tmp_path / "shared", studio.studio
    studio.post("view.export", camera=wire(view()), name="export", to="folder")
    pixels = (255 * painted(shot())[0]).round().astype(np.uint8)
    (shared / "final").mkdir()
    Image.fromarray(pixels).save(shared / "final" / "export.png")  # the camera is lost
    blob = saved_picture(served, "final/export.png")
    assert blob is not None and saved_picture(served, "final/export.png") is None
    checked = studio.post("picture.check", picture=blob.sha256, name="final/export.png")
    assert checked["camera_source"] == "sidecar" and 0 < checked["share"] < 0.2
    other = view().with_longest_side(96).to_json()
    (shared / "final" / "export.json").write_text(other)
    beside = studio.post("picture.check", picture=blob.sha256, name="final/export.png")
    assert beside["camera"]["width"] == 96, "the nearest one"
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "own.png").write_bytes((shared / "final" / "export.png").read_bytes())
    (tmp_path / "outside" / "own.json").write_text(other)
    (shared / "link").symlink_to(tmp_path / "outside", target_is_directory=True)
    for name in ("link/own.png", "../outside/own.png", "final/../../outside/own.png"):
        with contextlib.suppress(ValueError):
            assert saved_picture(served, name) is None
        checked = studio.post("picture.check", picture=blob.sha256, name=name)
        assert checked["camera_source"] == "export", "by its likeness, not by a file outside"


def test_the_folder_is_watched(studio: Live, tmp_path: Path) -> None:
    data = png_bytes(painted(shot())[0], view())
    with studio.greeted() as browser:
        event = None
        for attempt in range(40):  # the watch may begin after the file was written
            (tmp_path / "shared" / f"saved{attempt}.png").write_bytes(data + bytes([attempt]))
            time.sleep(0.4)
            browser.do("conflicts")
            event = next((e for e in browser.events if e["event"] == "picture"), None)
            if event:
                break
        assert event is not None and event["name"].startswith("saved")
        checked = browser.do("picture.check", picture=event["picture"], name=event["name"])
        assert checked["camera_source"] == "chunk" and json.dumps(checked["camera"])


def light(path: Path, pixels: np.ndarray, size: tuple[int, int] | None = None) -> bytes:
    """A file of linear light without a camera, as painting programs save views; size: of another shape than it."""
    resized = pixels if size is None else np.asarray(Image.fromarray(pixels).resize(size))
    write_sky(path, SkyMap(srgb_to_linear(resized.astype(np.float32) / 255), path.name))
    return path.read_bytes()


@pytest.mark.parametrize("ending", ["exr", "hdr"])
def test_light_that_is_no_sky_is_a_painted_view(ending: str, studio: Live, tmp_path: Path) -> None:
    """OpenEXR and Radiance hold environments and pictures; twice as wide as high are both."""
    shared, served = tmp_path / "shared", studio.studio
    pixels = to_uint8(painted(shot())[0])
    studio.post("view.export", camera=wire(view()), name="export", to="folder")
    light(shared / f"export.{ending}", pixels)
    blob = saved_picture(served, f"export.{ending}")
    assert blob is not None and blob.info.kind == "picture"
    checked = studio.post("picture.check", picture=blob.sha256, name=f"export.{ending}")
    assert 0 < checked["share"] < 0.2 and any("not as a sky" in note for note in checked["notes"])
    # Twice as wide as high: a sky, until a view of that shape was exported.
    light(shared / f"wide.{ending}", pixels, (64, 32))
    with pytest.raises(ValueError, match="a sky, for Light, Sky from a file"):
        saved_picture(served, f"wide.{ending}")
    sent = studio.send((shared / f"wide.{ending}").read_bytes(), f"wide.{ending}")
    refused = studio.http.post("/api/do/picture.check", json={"picture": sent, "name": f"wide.{ending}"})
    assert refused.status_code == 400 and "a sky is for Light" in refused.text
    studio.post("light.sky", file=sent)
    wide = replace(view(), width=192, cx=96.0)
    studio.post("view.export", camera=wire(wide), name="broad", to="folder")
    edited = np.clip(render(served.session.splats, wide).colors[0], 0, 1)
    edited[40:56, 88:104] = (1, 0, 0)
    light(shared / f"broad.{ending}", to_uint8(edited))
    blob = saved_picture(served, f"broad.{ending}")
    assert blob is not None
    checked = studio.post("picture.check", picture=blob.sha256, name=f"broad.{ending}")
    assert checked["camera"]["width"] == 192 and 0 < checked["share"] < 0.1


def test_a_wide_picture_that_carries_its_camera_is_no_sky(studio: Live) -> None:
    camera, light = replace(view(), width=192, cx=96.0), np.full((96, 192, 3), 0.5, np.float16)
    for texts, kind in (({}, "sky"), ({CAMERA_KEYWORD: camera.to_json()}, "picture")):
        blob = studio.studio.blobs.put(encode_exr(light, ("R", "G", "B"), texts), "wide.exr")
        assert blob.info.kind == kind


def test_aovs_beside_a_view_are_no_edits(studio: Live, tmp_path: Path) -> None:
    """As `render --aov` writes them into the watched folder."""
    shared = tmp_path / "shared"
    light(shared / "view_000.depth.exr", to_uint8(shot()))
    record = {**json.loads(view().to_json()), "aov": {"depth": {"file": "view_000.depth.exr"}}}
    (shared / "view_000.json").write_text(json.dumps(record))
    assert saved_picture(studio.studio, "view_000.depth.exr") is None
    (shared / "view_000.json").write_text(view().to_json())
    assert saved_picture(studio.studio, "view_000.depth.exr") is not None
