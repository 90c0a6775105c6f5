"""Sessions over a painter with networks: the same rows and fast weights as painting straight, after any detour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatpainter.cameras import same_camera
from splatpainter.models.config import RefineConfig
from splatpainter.models.local_config import LocalConfig
from splatpainter.models.local_network import LocalNetwork
from splatpainter.painter import Asset, Edit, EditSettings, Painter
from splatpainter.session import Session
from tests.lift.test_global import FRONT, SIDE, ball, draw, regraded
from tests.models.test_edit_propagation import model as carrying_model
from tests.support.lift_scenes import same_bits
from tests.support.painter_scenes import ASSET_BASE, BLUE, COPY, GREEN, LIFT, RED, built, dab, thing

SPLATS = thing()


def eight_bits(edit: Edit) -> Edit:
    """As a layer keeps it."""
    return replace(edit, image=np.floor(np.clip(np.nan_to_num(edit.image), 0, 1) * 255 + 0.5).astype(np.uint8))


EDITS = [eight_bits(dab(SPLATS, RED, 26)), eight_bits(dab(SPLATS, BLUE, 38)), eight_bits(dab(SPLATS, GREEN, 32, 38))]


def local_network(seed: int) -> LocalNetwork:
    torch.manual_seed(seed)
    return LocalNetwork(LocalConfig(refine=RefineConfig(blocks=1, fast_hidden=128, hidden=32, heads=4, patch=4))).eval()


def straight(painter: Painter, edits: list[Edit]) -> Asset:
    asset = painter.encode(replace(SPLATS, origin=np.arange(len(SPLATS))))
    for edit in edits:
        asset = painter.apply(asset, [edit])
    return asset


def same_state(state: Any, asset: Asset) -> bool:
    assert asset.encoding is not None and asset.encoding.state is not None
    one, two = (
        [weight for memory in (*one_state.blocks, one_state.detail or ()) for weight in memory]
        for one_state in (state, asset.encoding.state)
    )
    return len(one) == len(two) and all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


@pytest.mark.parametrize("config", [ASSET_BASE, LIFT], ids=["own", "lift"])
def test_layers_are_the_painter_applied_again_and_again(config, tmp_path: Path):
    painter, path = Painter(model=built(config, awake=0.02)), tmp_path / "a.splatproj"
    with Session(SPLATS, path, painter=painter) as session:
        for edit in EDITS[:2]:
            layer = session.layers.add("paint", [edit])
        expected = straight(painter, EDITS[:2])
        assert layer.operation.method == "ttt" and session.layers.facts(layer.id)["method"] == "ttt"  # pyright: ignore[reportAttributeAccessIssue]
        assert same_bits(session.splats, expected.splats)
        assert same_state(session.snapshot.state.painter_state, expected)
    with Session.load(path, painter=painter) as session:
        # From the stored state, which went through the file.
        session.layers.add("paint", [EDITS[2]])
        expected = straight(painter, EDITS)
        assert same_bits(session.splats, expected.splats) and same_state(session.snapshot.state.painter_state, expected)
        session.layers.set("1", visible=False)
        expected = straight(painter, EDITS[1:])
        assert same_bits(session.splats, expected.splats) and same_state(session.snapshot.state.painter_state, expected)
        session.undo()
        assert session.verify(repaint=True) == []


def test_a_session_keeps_what_global_edits_have_taught(tmp_path: Path) -> None:
    """Two relit views as layers are two edits one after the other; a hidden one has taught nothing; undo brings all of
    it back, and the file too."""
    splats, painter = ball(300), Painter(model=carrying_model())
    edits = [eight_bits(Edit(draw(regraded(splats), camera), camera)) for camera in (FRONT, SIDE)]

    def painted(edits: list[Edit]) -> tuple[np.ndarray, Any]:
        asset = painter.encode(splats, "ttt", ("global",))
        for edit in edits:
            asset = painter.apply(asset, [edit], "global", "ttt")
        assert asset.encoding is not None and asset.encoding.state is not None
        return asset.splats.sh, asset.encoding.state.so_far

    def same(session: Session, edits: list[Edit]) -> None:
        colors, expected = painted(edits)
        np.testing.assert_array_equal(session.splats.sh, colors)
        state = session.snapshot.state.painter_state.so_far
        np.testing.assert_array_equal(state.moved, expected.moved)
        assert len(state.pictures) == len(expected.pictures) == len(edits)
        for one, other in zip(state.pictures, expected.pictures, strict=True):
            np.testing.assert_array_equal(one.left, other.left)
            np.testing.assert_array_equal(one.mask, other.mask)
            assert same_camera(one.camera, other.camera)

    path = tmp_path / "a.splatproj"
    with Session(splats, path, painter=painter) as session:
        for edit in edits:
            session.layers.add("picture", [edit], mode="global", method="ttt")
        same(session, edits)
        session.layers.set("1", visible=False)
        same(session, edits[1:])
        session.undo()
        same(session, edits)
    with Session.load(path, painter=painter) as session:
        same(session, edits)


def test_without_the_weights_results_stay_and_only_new_ones_are_missing(tmp_path: Path):
    path = tmp_path / "a.splatproj"
    with Session(SPLATS, path, painter=Painter(model=built(awake=0.02))) as session:
        for edit in EDITS[:2]:
            session.layers.add("paint", [edit])
        composed = session.splats
    with Session.load(path, painter=Painter()) as session:
        assert same_bits(session.splats, composed)
        session.layers.set("1", visible=False)
        assert "needs a preset with trained weights" in session.layers.facts("2")["problem"]
        session.undo()
        assert same_bits(session.splats, composed)
        assert session.layers.set("2", method="lift").operation.method == "lift"  # pyright: ignore[reportAttributeAccessIssue]
        assert session.layers.facts("2")["method"] == "lift" and "note" in session.layers.facts("2")
        assert "another painter" not in session.layers.facts("2")["note"]


def test_other_weights_are_said(tmp_path: Path):
    path = tmp_path / "a.splatproj"
    with Session(SPLATS, path, painter=Painter(model=built(awake=0.02))) as session:
        for edit in EDITS[:2]:
            session.layers.add("paint", [edit])
    with Session.load(path, painter=Painter(model=built(awake=0.02, seed=8))) as session:
        assert "another painter" not in session.layers.facts("2")["note"]
        session.layers.set("1", visible=False)
        assert "computed by another painter than it was made with" in session.layers.facts("2")["note"]


@pytest.mark.parametrize(("seed", "expected"), [(0, False), (8, True)])
def test_other_weights_of_the_local_network_are_said(tmp_path: Path, seed: int, expected: bool):
    path = tmp_path / "a.splatproj"
    with Session(SPLATS, path, painter=Painter(local=local_network(0))) as session:
        for edit in EDITS[:2]:
            session.layers.add("paint", [edit], method="ttt")
        assert session.layers.facts("2")["method"] == "ttt"
    with Session.load(path, painter=Painter(local=local_network(seed))) as session:
        session.layers.set("1", visible=False)
        assert ("computed by another painter" in session.layers.facts("2").get("note", "")) == expected


def test_the_precision_of_layers_is_in_the_receipt_and_another_one_is_said(tmp_path: Path):
    path, net = tmp_path / "a.splatproj", built(awake=0.02)
    with Session(SPLATS, path, painter=Painter(model=net, settings=EditSettings(precision="bfloat16"))) as session:
        session.layers.add("paint", [EDITS[0]], method="lift")
        assert session.files.receipt().precision == ""
        session.layers.add("paint", [EDITS[1]], method="ttt")
        assert session.layers.facts("2")["precision"] == "bfloat16" and "precision" not in session.layers.facts("1")
        assert session.files.receipt().precision == "bfloat16"
        composed = session.splats
    with Session.load(path, painter=Painter(model=net, settings=EditSettings(precision="float32"))) as session:
        assert same_bits(session.splats, composed) and session.files.receipt().precision == "bfloat16"
        session.layers.set("1", visible=False)
        assert session.layers.facts("2")["precision"] == session.files.receipt().precision == "float32"
        assert "computed by another painter than it was made with" in session.layers.facts("2")["note"]
        session.layers.set("2", visible=False)
        assert session.files.receipt().precision == ""


def test_painters_that_replace_all_rows_are_refused():
    with Session(SPLATS, painter=Painter(model=built(COPY, awake=0.02))) as session:
        with pytest.raises(ValueError, match="representation 'copy'"):
            session.layers.add("paint", EDITS[:1])
        session.layers.add("paint", EDITS[:1], method="lift")
