"""Pictures from elsewhere: their camera is found, moves are taken back, changes and side effects are told apart."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from studio_scenes import Live, ball, live, make_studio, view, wire

from splatpainter.render import render
from splatpainter.studio import pictures
from splatpainter.studio.pictures import png_bytes
from splatpainter.studio.watch import saved_picture


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    (tmp_path / "shared").mkdir()
    with live(make_studio(tmp_path, shared=tmp_path / "shared")) as own:
        yield own


def post(studio: Live, name: str, /, **fields) -> dict:
    answer = studio.http.post(f"/api/do/{name}", json=fields)
    assert answer.status_code == 200, answer.text
    return answer.json()


def send(studio: Live, data: bytes, name: str = "picture.png") -> str:
    return studio.http.post(f"/api/blobs?name={name}", content=data).json()["blob"]


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
    given = post(studio, "view.export", camera=wire(view()))
    image, mask = painted(fetch(studio, given["picture"]) / 255)
    found = post(studio, "picture.check", picture=send(studio, png_bytes(image, view())))
    assert found["found"] == "chunk" and found["warnings"] == [] and found["shift"] == [0, 0]
    assert np.allclose(found["camera"]["world_to_camera"], view().world_to_camera)
    seen = fetch(studio, found["mask"]) > 127
    assert (seen & mask).sum() > 0.95 * mask.sum() and (seen & ~mask).sum() < 0.2 * mask.sum()
    assert found["share"] == pytest.approx(seen.mean())


def test_cameras_are_found_in_the_sidecar_the_exports_and_by_resemblance(studio: Live, tmp_path: Path) -> None:
    for angle in (0, 90, 180):
        post(studio, "view.export", camera=wire(view(96, angle)), name=f"from {angle}", to="folder")
    assert sorted(p.name for p in (tmp_path / "shared").iterdir())[:2] == ["from 0.json", "from 0.png"]
    image, _ = painted(shot(96, 90))
    found = post(studio, "picture.check", picture=send(studio, png_bytes(image), "anything.png"))
    assert found["found"] == "export" and np.allclose(found["camera"]["world_to_camera"], view(96, 90).world_to_camera)
    found = post(studio, "picture.check", picture=send(studio, png_bytes(image)), name="from 180.jpg")
    assert found["found"] == "sidecar"
    assert np.allclose(found["camera"]["world_to_camera"], view(96, 180).world_to_camera)
    (tmp_path / "shared" / "from 0.json").unlink()
    found = post(studio, "picture.check", picture=send(studio, png_bytes(image)), name="from 0.png")
    assert found["found"] == "export" and np.allclose(found["camera"]["world_to_camera"], view().world_to_camera)
    noise = np.random.default_rng(0).uniform(size=(96, 96, 3))
    lost = studio.http.post("/api/do/picture.check", json={"picture": send(studio, png_bytes(noise))})
    assert lost.status_code == 400 and "turn to its view" in lost.json()["error"]["hint"]
    given = post(studio, "picture.check", picture=send(studio, png_bytes(noise)), camera=wire(view()))
    assert given["found"] == "given" and "use it as a look" in given["warnings"][0]["message"]


def test_resized_and_moved_pictures_are_put_straight(studio: Live) -> None:
    image, mask = painted(shot())
    big = Image.fromarray((image * 255).astype(np.uint8)).resize((240, 240), Image.Resampling.BICUBIC)
    file = io.BytesIO()
    big.save(file, "PNG")
    found = post(studio, "picture.check", picture=send(studio, file.getvalue()), camera=wire(view()))
    assert found["notes"] == ["resampled from 240x240 to its camera's 96x96"]
    assert fetch(studio, found["picture"]).shape == (96, 96, 3)
    rolled = np.roll(image, (2, -3), (0, 1))
    found = post(studio, "picture.check", picture=send(studio, png_bytes(rolled)), camera=wire(view()))
    assert found["shift"] == [-3, 2]
    seen = fetch(studio, found["mask"]) > 127
    assert (seen & mask).sum() > 0.9 * mask.sum() and (seen & ~mask).mean() < 0.03
    wide = studio.http.post(
        "/api/do/picture.check", json={"picture": send(studio, png_bytes(image[:60])), "camera": wire(view())}
    )
    assert wide.json()["error"]["hint"] == "resize without cropping"


def test_side_effects_outside_the_edit_are_shown(studio: Live) -> None:
    image, mask = painted(shot())
    drifted = image.copy()
    drifted[:, :48] = np.where(mask[:, :48, None], image[:, :48], image[:, :48] + 3 / 255)
    found = post(studio, "picture.check", picture=send(studio, png_bytes(drifted)), camera=wire(view()))
    assert "outside the edit" in found["warnings"][0]["message"]
    red = fetch(studio, found["warnings"][0]["picture"])
    assert red.shape == (96, 96, 4) and red[10, 10, 3] > 0 and red[10, 90, 3] == 0


def test_the_threshold_moves_the_mask(studio: Live) -> None:
    image = shot()
    image[20:40, 20:40] = np.clip(image[20:40, 20:40] + 0.1, 0, 1)
    picture = send(studio, png_bytes(image))
    shares = [
        post(studio, "picture.check", picture=picture, camera=wire(view()), threshold=t)["share"] for t in (0.01, 0.2)
    ]
    assert shares[0] > 0.03 and shares[1] == 0


def test_a_picture_of_another_asset_is_warned_of(studio: Live) -> None:
    from dataclasses import replace

    image, _ = painted(shot())
    other = replace(view(), asset_sha256="0" * 64)
    found = post(studio, "picture.check", picture=send(studio, png_bytes(image, other)))
    assert "another asset" in found["warnings"][0]["message"]


@pytest.mark.parametrize(("right", "down"), [(0, 0), (1, 0), (-2, 3), (3, -3)])
def test_whole_pixel_moves_are_measured(right: int, down: int) -> None:
    image, _ = painted(shot())
    assert pictures.shift_of(np.roll(image, (down, right), (0, 1)), shot()) == (right, down)
    back = pictures.moved_back(np.roll(image, (down, right), (0, 1)), shot(), right, down)
    assert np.array_equal(back[8:-8, 8:-8], image[8:-8, 8:-8])


def test_a_regraded_or_foreign_picture_is_not_taken_for_a_moved_one() -> None:
    assert pictures.shift_of(shot() ** 2, shot()) == (0, 0)
    assert pictures.shift_of(np.random.default_rng(0).uniform(size=(96, 96, 3)), shot()) == (0, 0)


def test_saved_pictures_are_offered_once_and_whole(studio: Live, tmp_path: Path) -> None:
    shared, own = tmp_path / "shared", studio.studio
    post(studio, "view.export", camera=wire(view()), name="export", to="folder")
    assert saved_picture(own, "export.png") is None  # the studio's own writing
    data = png_bytes(painted(shot())[0], view())
    (shared / "export.png").write_bytes(data[: len(data) // 2])
    assert saved_picture(own, "export.png") is None  # half a file
    (shared / "export.png").write_bytes(data)
    blob = saved_picture(own, "export.png")
    assert blob is not None and blob.path.read_bytes() == data
    assert saved_picture(own, "export.png") is None  # offered before
    (shared / "page.png").write_bytes(b"<html>")
    (shared / "rows.splat").write_bytes(b"\1" * 32)
    for name in ("page.png", "rows.splat", "missing.png", "../own.splatproj"):
        assert saved_picture(own, name) is None


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
        found = browser.do("picture.check", picture=event["picture"], name=event["name"])
        assert found["found"] == "chunk" and json.dumps(found["camera"])
