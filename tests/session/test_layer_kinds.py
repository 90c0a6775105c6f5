"""What a kind of layer is and does is one value: a kind that the package does not know is one dataclass, and operations
that read no files are layers as they are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from splatpainter.io.files import sha256
from splatpainter.operations.light import Delight, Relight
from splatpainter.operations.pixelate import pixelate
from splatpainter.operations.region import Region
from splatpainter.painter import Painter
from splatpainter.server.describe import layer_info
from splatpainter.session import Session
from splatpainter.session.document import layer_operation
from splatpainter.session.document.document import Layer
from splatpainter.session.document.layer_mask import LayerMask, by_rule
from splatpainter.session.document.layer_operation import LayerOperation, LayerWork, layer_kinds, operation_of_layer
from splatpainter.session.kinds.painted_layers import PaintLayer
from splatpainter.session.replay.delta import between
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.session.selection.selection import Selection
from tests.support.lift_scenes import same_bits
from tests.support.session_scenes import RED, dab, flat, load, print_of
from tests.support.studio_scenes import ball


@dataclass(frozen=True)
class TintLayer(LayerOperation):
    """A kind of another package: base colours move by some amount."""

    kind: ClassVar[str] = "tint"

    amount: float = 0.0

    def check(self) -> None:
        if abs(self.amount) > 1:
            raise ValueError(f"tint: expected an amount of -1 to 1, got {self.amount:g}")

    def result(self, work: LayerWork) -> LayerResult:
        sh = work.splats.sh.copy()
        sh[:, 0] += np.float32(self.amount)
        return LayerResult(between(work.splats, replace(work.splats, sh=sh)), {"note": "tinted"})


@pytest.fixture
def tint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(layer_operation.KINDS, "tint", f"{__name__}:TintLayer")


def test_a_kind_that_the_package_does_not_know_is_a_layer_like_all_others(tint: None, tmp_path: Path) -> None:
    path = tmp_path / "tinted.splatproj"
    with flat(project=path) as session:
        before = session.splats
        layer = session.layers.add("tint", amount=0.5)
        np.testing.assert_allclose(session.splats.sh[:, 0], before.sh[:, 0] + 0.5, atol=1e-6)
        assert session.layers.facts(layer.id)["note"] == "tinted" and layer.name == "Tint"
        # Opacity, options, masks, order, undo and files know nothing of it.
        session.layers.set(layer.id, opacity=0.5)
        np.testing.assert_allclose(session.splats.sh[:, 0], before.sh[:, 0] + 0.25, atol=1e-6)
        session.layers.set(layer.id, amount=-0.25, opacity=1.0)
        np.testing.assert_allclose(session.splats.sh[:, 0], before.sh[:, 0] - 0.25, atol=1e-6)
        session.masks.set(layer.id, LayerMask(parts=(by_rule("height", 2, 3),)))
        assert same_bits(session.splats, before)
        for _ in range(4):
            session.undo()
        assert same_bits(session.splats, before) and not session.layers
        for _ in range(3):
            session.redo()
        session.layers.add("paint", [dab(RED)])
        session.layers.move(layer.id, 1)
        assert layer_info(session, session.layers.by_id(layer.id)).parameters == {"amount": -0.25}
        session.files.export_layer(layer.id, tmp_path / "a.splatlayer")
        expected = print_of(session)
        with pytest.raises(ValueError, match="^layer: tint: expected an amount of -1 to 1, got 2$"):
            session.layers.set(layer.id, amount=2.0)
        with pytest.raises(ValueError, match="expected no views for kind tint, got 1; limit it by a mask instead"):
            session.layers.add("tint", [dab()])
    with load(path) as session:
        assert print_of(session) == expected and session.verify(repaint=True) == []
    with flat() as session:
        assert session.files.import_layer(tmp_path / "a.splatlayer").operation == TintLayer(amount=-0.25)


def test_where_nobody_knows_the_kind_the_project_says_so(tint: None, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "tinted.splatproj"
    with flat(project=path) as session:
        session.layers.add("tint", amount=0.5)
    monkeypatch.delitem(layer_operation.KINDS, "tint")
    with pytest.raises(ValueError, match=r"tinted\.splatproj: .*expected a kind of paint, .*, got 'tint'") as error:
        load(path)
    assert "\n" not in str(error.value)


def test_the_key_of_a_result_is_the_value() -> None:
    layer = Layer("1", "a", PaintLayer(angle_limit=40))
    assert replace(layer, id="2", name="b", opacity=0.5).key == layer.key
    assert replace(layer, operation=PaintLayer(angle_limit=41)).key != layer.key
    assert replace(layer, operation=PaintLayer(angle_limit=40, depth_edge_limit=None)).key == layer.key


@pytest.mark.parametrize("kind", [kind for kind in layer_kinds() if kind not in ("light", "relief", "pixelate")])
def test_every_kind_is_what_its_record_says(kind: str) -> None:
    operation = operation_of_layer({"kind": kind}, "layer")
    assert operation.kind == kind and operation_of_layer(operation.record(), "layer") == operation
    with pytest.raises(ValueError, match=r"^layer: .*'brush'") as error:
        operation_of_layer({"kind": kind, "brush": 3}, "layer")
    assert "\n" not in str(error.value)


def test_light_is_a_layer(tmp_path: Path) -> None:
    splats, path = ball(300), tmp_path / "lit.splatproj"
    light = Relight(sun=("40,30",), fill=0.2)
    with Session(splats, path, painter=Painter.load("lift")) as session:
        before = session.splats
        layer = session.layers.add(light, name="Evening")
        lit = session.splats
        assert np.array_equal(lit.means, before.means) and (lit.sh != before.sh).any()
        once = light.apply(session._core.painter.encode(splats)).splats
        np.testing.assert_array_equal(lit.sh, once.sh)  # as the command line lights a file
        session.layers.set(layer.id, opacity=0.25)
        # Its opacity is the share of the new light, in linear light: the option `mix`.
        quarter = replace(light, mix=0.25).apply(session._core.painter.encode(splats)).splats
        np.testing.assert_allclose(session.splats.sh, quarter.sh, atol=1e-6)
        session.layers.set(layer.id, opacity=1.0, sun=("220,30",))
        assert (session.splats.sh != lit.sh).any()
        session.layers.add("delight", mix=0.5)
        assert [one.kind for one in session.layers] == ["light", "delight"]
        expected = print_of(session)
        for _ in range(4):
            session.undo()
        assert same_bits(session.splats, before)
        for _ in range(4):
            session.redo()
        assert print_of(session) == expected
    with Session.load(path, painter=Painter.load("lift")) as session:
        assert print_of(session) == expected and session.verify(repaint=True) == []
        assert session.layers[1].operation.record() == {**Delight(mix=0.5).record()}


def test_a_layer_names_no_file_that_the_project_does_not_hold() -> None:
    with flat() as session:
        with pytest.raises(ValueError, match=r"^layer: expected options of light without files, .* got night\.hdr"):
            session.layers.add("light", hdri="night.hdr")
        for hostile in (
            {"hdri": "/dev/zero"},
            {"rig": "/dev/zero"},
            {"sun": ["40,30"], "where": ["mask=/dev/zero@/dev/zero"]},
        ):
            with pytest.raises(ValueError, match="^layer: expected (options of light without files|a selection or)"):
                session.layers.add("light", **hostile)  # pyright: ignore[reportArgumentType]
        assert not session.layers


def test_pixels_over_what_is_selected_are_a_layer(tmp_path: Path) -> None:
    splats, path = ball(600), tmp_path / "censored.splatproj"
    with Session(splats, path, painter=Painter.load("lift")) as session:
        weights = (splats.means[:, 0] > 0).astype(np.float32)
        data = Selection.of(weights, session.splats, session.original).to_png()
        layer = session.layers.add("pixelate", size="20%", selection=sha256(data), attached=[data])
        changed = (session.splats.sh != splats.sh).any((1, 2))
        region = Region("selection", ((lambda _: weights,),))
        np.testing.assert_array_equal(session.splats.sh, pixelate(session.original, region, size="20%").splats.sh)
        assert changed[weights > 0].mean() > 0.9 and (session.splats.sh[changed, 1:] == 0).all()
        session.layers.set(layer.id, size="10%", color="#808080")
        assert len(np.unique(session.splats.sh[changed, 0], axis=0)) == 1
        for wrong in ({"size": "0%"}, {"color": "grey"}, {"margin": -1}, {"where": ["box=0,0,0,1,1,1"]}):
            with pytest.raises(ValueError, match="^layer: ") as error:
                session.layers.set(layer.id, **wrong)  # pyright: ignore[reportArgumentType]
            assert "\n" not in str(error.value)
        session.undo()
        session.undo()
        assert same_bits(session.splats, session.original)
        session.redo()
        with pytest.raises(ValueError, match="expected a selection"):
            session.layers.add("pixelate")
    with Session.load(path, painter=Painter.load("lift")) as session:
        assert session.verify(repaint=True) == []
