"""Operations (operations/) as layers: what `splatpainter light` does to a file, as a layer that can be faded, masked,
reordered and undone. Only those that ask no source, and read no files but those that the project can hold: what it does
not hold is not there when it is replayed elsewhere."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from splatpainter.operations.operation import Operation, Tools, operation_of
from splatpainter.painter import Asset
from splatpainter.session.document.layer_operation import Coverage, LayerOperation, LayerWork
from splatpainter.session.document.layer_view import Blend, is_hash
from splatpainter.session.replay.delta import Delta, between, without_source
from splatpainter.session.replay.layer_blending import blend_delta, mix_sh, mixed
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.session.replay.light_below import mix_light
from splatpainter.splats import Splats
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

REGION_OPTIONS = ("where", "around")
"""Options of operations that are regions (operations/region.py)."""


@dataclass(frozen=True)
class OperationLayer(LayerOperation):
    """An operation, on everything or on what is selected."""

    covers: ClassVar[Coverage] = "as below"

    operation: Operation = field(default_factory=Operation)
    selection: str | None = field(default=None, metadata={"blob": True})
    """Hash of the selection (Selection.to_png) that it keeps to; None: everything."""
    held: dict[str, str] = field(default_factory=dict)
    """Option -> hash of what the project holds in place of the file that it names (Operation.packed)."""

    @property
    def kind(self) -> str:  # type: ignore[override]
        """That of the operation."""
        return self.operation.kind

    @property
    def options(self) -> Operation:
        return self.operation

    def check(self) -> None:
        # A project comes from anybody: what it says must not open files of this machine when it is replayed. Regions
        # may name files in their words, so a selection or a mask stands in for them.
        if any(getattr(self.operation, name, ()) for name in REGION_OPTIONS):
            raise ValueError(f"expected a selection or a mask of {self.kind}, not {' or '.join(REGION_OPTIONS)}")
        can = self.operation.holds
        if wrong := [name for name, value in self.held.items() if name not in can or not is_hash(value)]:
            raise ValueError(f"expected hashes of held files of {', '.join(can) or 'no option'}, got {brief(wrong[0])}")
        # What is held is asked for by its hash; the name beside it is a word, and opens nothing.
        default = type(self.operation)()
        named = replace(self.operation, **{name: getattr(default, name) for name in self.held})
        if named.files() or named.outputs():
            paths = ", ".join(path.name for path in (*named.files(), *named.outputs()))
            expected = f"options of {self.kind} without files, which a project does not hold"
            raise ValueError(f"expected {expected}, got {paths}")

    def record(self) -> dict[str, Any]:
        blobs = {"selection": self.selection, "held": dict(self.held)}
        return self.operation.record() | {name: value for name, value in blobs.items() if value}

    def blobs(self) -> set[str]:
        return super().blobs() | set(self.held.values())

    def changes(self) -> dict[str, Any]:
        return {name: value for name, value in self.record().items() if name != "kind"}

    def option_names(self) -> tuple[str, ...]:
        return (*(entry.name for entry in dataclasses.fields(self.operation)), "selection", "held")

    @classmethod
    def build(cls, kind: str, options: Mapping[str, Any], where: str) -> LayerOperation:
        given = dict(options)
        selection = given.pop("selection", None)
        if not isinstance(selection, str | None):
            raise ValueError(f"{where}: expected selection as the hash of a picture, got {selection!r:.40}")
        held = given.pop("held", {})
        if not isinstance(held, Mapping) or not all(isinstance(name, str) for name in held):
            raise ValueError(f"{where}: expected held as options with hashes of pictures, got {brief(held)}")
        operation = operation_of({"kind": kind, **given}, where)
        try:
            return cls(operation, selection, dict(held))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None

    @property
    def relights(self) -> bool:
        return self.operation.relights

    @property
    def needs_masks(self) -> bool:
        return False

    def result(self, work: LayerWork) -> LayerResult:
        # Numbered from 0, as a file's rows are: what it appends then says which Gaussian below it came from.
        below = replace(without_source(work.splats), origin=np.arange(len(work.splats)))
        asset = Asset(below, original=without_source(work.original), unlit=work.unlit if self.relights else None)
        tools = self._tools(work)
        if self.selection is None:
            edited = self.operation.apply(asset, tools)
            splats = edited.splats
        elif (exact := self.operation.apply_selected(asset, work.selected(self.selection))) is not None:
            edited, splats = exact, exact.splats
        else:
            edited = self.operation.apply(asset, tools)
            weights = work.selected(self.selection)
            splats = mixed(weights, below, edited.splats)
            if self.relights:
                splats = replace(splats, sh=mix_light(below.sh, edited.splats.sh, weights, "normal", below.color_space))
        note = "" if edited.receipt is None else edited.receipt.note
        return LayerResult(between(below, without_source(splats)), {"note": note} if note else {})

    def glance(self, work: LayerWork) -> np.ndarray | None:
        sh = self.operation.glance(without_source(work.splats), self._tools(work))
        if sh is None or self.selection is None:
            return sh
        weights, space = work.selected(self.selection), work.splats.color_space
        return mix_light(work.splats.sh[:, :1], sh, weights, "normal", space)

    def mix(
        self,
        below: Splats,
        delta: Delta,
        opacity: float,
        blend: Blend,
        strength: np.ndarray | None,
        mask: np.ndarray | None,
    ) -> Delta:
        mixing = partial(mix_light, space=below.color_space) if self.relights else mix_sh
        return blend_delta(below, delta, opacity, blend, strength, mask, mixing)

    def _tools(self, work: LayerWork) -> Tools:
        return Tools(held={name: work.blob(sha256) for name, sha256 in self.held.items()}, unlit=work.unlit)
