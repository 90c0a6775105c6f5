"""Selections over HTTP: chosen on a view, seen from all, limiting strokes, pictures and looks; hidden, kept by name."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.server.protocol import CameraInfo
from tests.support import studio_scenes
from tests.support.studio_scenes import Live, view

CAMERA = CameraInfo.of(view()).model_dump()
SIZE = 96


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    with studio_scenes.live(studio_scenes.make_studio(tmp_path)) as one:
        yield one


def png(mask: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray((mask * 255).astype(np.uint8)).convert("RGB").save(file, "png")
    return file.getvalue()


def left() -> np.ndarray:
    mask = np.zeros((SIZE, SIZE))
    mask[:, : SIZE // 2] = 1
    return mask


def area(live: Live, mask: np.ndarray, **fields: Any) -> dict[str, Any]:
    return live.post("selection.area", camera=CAMERA, mask=live.send(png(mask)), **fields)


def seen(live: Live, camera: dict[str, Any] = CAMERA) -> np.ndarray:
    blob = live.post("selection.view", camera=camera)["mask"]
    return np.asarray(Image.open(io.BytesIO(live.http.get(f"/api/blobs/{blob}").content)).convert("L")) / 255


def selection(live: Live) -> dict[str, Any]:
    return live.http.get("/api/state").json()["selection"]


def refused(live: Live, name: str, /, **fields: Any) -> str:
    answer = live.http.post(f"/api/do/{name}", json=fields)
    assert answer.status_code != 200
    return answer.text


def test_an_area_is_exact_on_its_view_and_follows_the_asset(live: Live) -> None:
    first = selection(live)
    assert first["gaussians"] == 0 and live.post("selection.view", camera=CAMERA)["mask"] is None
    answer = area(live, left())
    assert 50 < answer["gaussians"] < 300 and 0 < answer["share"] < 0.5
    assert selection(live)["revision"] > first["revision"]
    assert np.array_equal(seen(live), left())
    other = CameraInfo.of(view(angle=40)).model_dump()
    around = seen(live, other)
    assert 0.02 < around.mean() < 0.4 and around[:, 80:].max() == 0
    top = np.zeros((SIZE, SIZE))
    top[: SIZE // 2] = 1
    area(live, top, how="intersect")
    assert np.array_equal(seen(live), left() * top)
    before = selection(live)["gaussians"]
    through = area(live, left() * top, through=True)["gaussians"]
    assert through > 1.3 * before
    live.post("selection.change", to="none")
    live.post("selection.change", to="again")
    assert selection(live)["gaussians"] == pytest.approx(through, abs=2)


def test_what_lies_beside_an_outline_is_known_where_one_view_made_the_selection(live: Live) -> None:
    selected = live.studio.selection
    assert selected.beside() is None
    area(live, left())
    beside, right = selected.beside(), live.studio.session.splats.means[:, 0]
    assert beside is not None and beside[right > 0.05].all() and not beside[right < -0.05].any()
    # More of the same view belongs to the outline; what another view or tool adds has none.
    low = np.zeros((SIZE, SIZE))
    low[SIZE // 2 :] = 1
    area(live, low, how="subtract")
    less = selected.beside()
    assert less is not None and less.sum() > 1.3 * beside.sum()
    other = CameraInfo.of(view(angle=40)).model_dump()
    live.post("selection.area", camera=other, mask=live.send(png(low)), how="add")
    assert selected.beside() is None
    area(live, left(), how="add")
    assert selected.beside() is None
    area(live, left())
    live.post("selection.change", to="invert")
    assert selected.beside() is None
    area(live, left())
    live.post("selection.change", to="grow", radius=0.2)
    assert selected.beside() is None
    live.post("selection.change", to="none")
    assert selected.beside() is None


def test_every_kind_of_selecting(live: Live) -> None:
    total = live.post("selection.change", to="all")["gaussians"]
    assert total == 600
    assert live.post("selection.change", to="invert")["gaussians"] == 0
    assert "nothing is selected" in refused(live, "selection.change", to="grow", radius=0.1)
    half = live.post("selection.box", low=[-2, -2, -2], high=[2, 0, 2])["gaussians"]
    assert 200 < half < 400
    assert live.post("selection.change", to="grow", radius=0.2)["gaussians"] > half
    assert live.post("selection.change", to="shrink", radius=0.4)["gaussians"] < half
    assert live.post("selection.change", to="feather", radius=0.2)["gaussians"] > 0
    assert "a radius above 0" in refused(live, "selection.change", to="grow", radius=0)
    assert live.post("selection.change", to="connected")["gaussians"] == 600
    assert "no floaters" in refused(live, "selection.change", to="floaters")
    high = live.post("selection.attribute", camera=CAMERA, attribute="height", low=0.9)["gaussians"]
    assert 10 < high < 120
    alike = live.post("selection.color", camera=CAMERA, x=48.5, y=48.5, tolerance=0.05)["gaussians"]
    assert 0 < alike < 400
    live.post("selection.box", low=[-2, -2, -2], high=[2, 0, 2])
    live.post("selection.save", name="Top")
    live.post("selection.change", to="none")
    assert selection(live)["names"] == ["Top"]
    assert live.post("selection.recall", name="Top")["gaussians"] == half
    live.post("selection.delete", name="Top")
    assert selection(live)["names"] == []
    assert "expected one of none" in refused(live, "selection.recall", name="Top")


def stroke(live: Live, kind: str = "paint") -> dict[str, Any]:
    rgba = np.zeros((20, 60, 4), np.uint8)
    rgba[:] = (230, 30, 30, 255)
    name = live.post("paint.begin", camera=CAMERA, kind=kind)["stroke"]
    patch = base64.b64encode(rgba.tobytes()).decode()
    live.post("paint.dab", stroke=name, x=18, y=38, width=60, height=20, rgba=patch)
    return live.post("paint.end", stroke=name)["layer"]


def changed(live: Live, before: np.ndarray) -> np.ndarray:
    from splatpainter.rendering import render

    return np.abs(render(live.studio.session.splats, view()).colors[0] - before).max(-1)


def picture(live: Live) -> np.ndarray:
    from splatpainter.rendering import render

    return render(live.studio.session.splats, view()).colors[0].copy()


def test_strokes_pictures_and_looks_keep_to_the_selection(live: Live) -> None:
    area(live, left())
    before = picture(live)
    stroke(live)
    change = changed(live, before)
    assert change[42:54, 24:40].mean() > 0.1 and change[42:54, 56:74].mean() < 0.01
    live.post("undo")
    edited = before.copy()
    edited[40:56, 20:76] = (0.1, 0.9, 0.1)
    blob = live.send(png_of(edited))
    live.post("edit", views=[{"camera": CAMERA, "picture": blob}], kind="picture", name="Green")
    change = changed(live, before)
    assert change[42:54, 24:40].mean() > 0.1 and change[42:54, 56:74].mean() < 0.01
    live.post("undo")
    live.post("selection.box", low=[-2, -2, -2], high=[0, 2, 2])
    old = live.studio.session.splats
    layer = live.post("look.commit", look={"exposure": -2})["layer"]
    now = live.studio.session.splats
    different = (old.sh != now.sh).any((1, 2))
    assert different.any() and not different[old.means[:, 0] > 0].any()
    live.post("layer.set", layer=layer["id"], parameters={"exposure": 1.0})
    assert live.studio.session.layers.by_id(layer["id"]).operation.selection  # pyright: ignore[reportAttributeAccessIssue]
    again = (old.sh != live.studio.session.splats.sh).any((1, 2))
    assert again.any() and not again[old.means[:, 0] > 0].any()
    live.post("look.preview", look={"exposure": -2})


def png_of(image: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)).save(file, "png")
    return file.getvalue()


def test_nothing_selected_there_is_one_line(live: Live) -> None:
    bottom = np.zeros((SIZE, SIZE))
    bottom[80:] = 1
    area(live, bottom)
    name = live.post("paint.begin", camera=CAMERA)["stroke"]
    patch = base64.b64encode(bytes([200, 0, 0, 255] * 100)).decode()
    live.post("paint.dab", stroke=name, x=40, y=40, width=10, height=10, rgba=patch)
    assert "nothing was painted where something is selected" in refused(live, "paint.end", stroke=name)
    assert "expected the shape of its view" in refused(
        live, "selection.area", camera=CAMERA, mask=live.send(png(np.ones((10, 50))))
    )


def test_hiding_and_cropping(live: Live) -> None:
    assert "nothing is selected" in refused(live, "selection.hide")
    live.post("selection.box", low=[-2, -2, -2], high=[0, 2, 2])
    layer = live.post("selection.hide", name="Left")["layer"]
    assert layer["kind"] == "hide" and layer["name"] == "Left" and selection(live)["gaussians"] == 0
    splats = live.studio.session.splats
    inside = splats.means[:, 0] <= 0
    assert (splats.opacities[inside] == 0).all() and (splats.opacities[~inside] > 0).all() and len(splats) == 600
    live.post("undo")
    live.post("selection.box", low=[-2, -2, -2], high=[0, 2, 2])
    live.post("selection.hide", name="Crop", rest=True)
    splats = live.studio.session.splats
    assert (splats.opacities[~inside] == 0).all() and (splats.opacities[inside] > 0).all()
    assert live.post("verify")["proved"]


def undo_counts(live: Live) -> tuple[int, int, int]:
    state = live.http.get("/api/state").json()
    return state["cursor"], state["selection"]["undo"], state["selection"]["redo"]


def test_undo_goes_through_selections_between_the_steps(live: Live) -> None:
    """Selections, a layer that hides, more selections: back and forth through all of them, the drawn edge included."""
    area(live, left())
    drawn = seen(live)
    live.post("selection.change", to="invert")
    inverted = selection(live)["gaussians"]
    assert undo_counts(live) == (0, 2, 0)
    live.post("selection.hide", name="Hide")
    assert undo_counts(live) == (1, 0, 0) and selection(live)["gaussians"] == 0
    live.post("selection.change", to="all")
    every = selection(live)["gaussians"]
    assert undo_counts(live) == (1, 1, 0)

    went = []
    for name, count in (("undo", 4), ("redo", 4)):
        for _ in range(count):
            live.post(name)
            went.append((*undo_counts(live), selection(live)["gaussians"]))
    lefts = 600 - inverted
    assert [one[3] for one in went] == pytest.approx([0, inverted, lefts, 0, lefts, inverted, 0, every], abs=40)
    assert [one[0] for one in went] == [1, 0, 0, 0, 0, 0, 1, 1]
    assert [one[1:3] for one in went] == [(0, 1), (2, 0), (1, 1), (0, 2), (1, 1), (2, 0), (0, 1), (1, 0)]
    live.post("jump", cursor=0)
    assert selection(live)["gaussians"] == inverted
    live.post("undo")
    assert np.abs(seen(live) - drawn).max() < 0.01, "the drawn edge, to the pixel"
    live.post("selection.change", to="none")
    assert undo_counts(live) == (0, 2, 0), "a new selection drops those that were undone"
    live.post("redo")
    assert undo_counts(live)[0] == 1, "and not the steps of the document"
    live.post("jump", cursor=0)
    live.post("selection.change", to="all")
    live.post("selection.hide", name="All of it")  # takes the place, and the number, of the step that was undone
    assert undo_counts(live) == (1, 0, 0)
    live.post("undo")
    assert undo_counts(live)[0] == 0 and selection(live)["gaussians"] == 600
    for _ in range(4):
        live.post("undo")
    assert undo_counts(live)[:2] == (0, 0) and selection(live)["gaussians"] == 0


def test_old_selections_are_forgotten_where_there_are_many(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatpainter.server.selection_history.MAX_BYTES", 2500)
    for _ in range(6):
        live.post("selection.change", to="all")
    back = undo_counts(live)[1]
    assert 2 <= back <= 4
    for _ in range(back + 1):
        live.post("undo")
    assert selection(live)["gaussians"] == 600 and undo_counts(live) == (0, 0, back)
