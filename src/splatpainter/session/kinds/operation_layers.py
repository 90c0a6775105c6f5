"""Operations (operations/) as layers: what `splatpainter light` does to a file, as a layer that can be faded, masked,
reordered and undone. Only those that read no files and ask no source: what a project does not hold is not there when it
is replayed elsewhere."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from splatpainter.operations.operation import Operation, operation_of
from splatpainter.painter import Asset
from splatpainter.session.document.layer_operation import Coverage, LayerOperation, LayerWork
from splatpainter.session.replay.delta import between, without_source
from splatpainter.session.replay.layer_blending import mix_sh, mixed
from splatpainter.session.replay.layer_result import LayerResult

REGION_OPTIONS = ("where", "around")
"""Options of operations that are regions (operations/region.py)."""


@dataclass(frozen=True)
class OperationLayer(LayerOperation):
    """An operation, on everything or on what is selected."""

    covers: ClassVar[Coverage] = "as below"

    operation: Operation = field(default_factory=Operation)
    selection: str | None = field(default=None, metadata={"blob": True})
    """Hash of the selection (Selection.to_png) that it keeps to; None: everything."""

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
        if self.operation.files() or self.operation.outputs():
            paths = ", ".join(path.name for path in (*self.operation.files(), *self.operation.outputs()))
            expected = f"options of {self.kind} without files, which a project does not hold"
            raise ValueError(f"expected {expected}, got {paths}")

    def record(self) -> dict[str, Any]:
        return self.operation.record() | ({} if self.selection is None else {"selection": self.selection})

    def changes(self) -> dict[str, Any]:
        return {name: value for name, value in self.record().items() if name != "kind"}

    def option_names(self) -> tuple[str, ...]:
        return (*(entry.name for entry in dataclasses.fields(self.operation)), "selection")

    @classmethod
    def build(cls, kind: str, options: Mapping[str, Any], where: str) -> LayerOperation:
        given = dict(options)
        selection = given.pop("selection", None)
        if not isinstance(selection, str | None):
            raise ValueError(f"{where}: expected selection as the hash of a picture, got {selection!r:.40}")
        operation = operation_of({"kind": kind, **given}, where)
        try:
            return cls(operation, selection)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None

    @property
    def needs_masks(self) -> bool:
        return False

    def result(self, work: LayerWork) -> LayerResult:
        # Numbered from 0, as a file's rows are: what it appends then says which Gaussian below it came from.
        below = replace(without_source(work.splats), origin=np.arange(len(work.splats)))
        asset = Asset(below, original=without_source(work.original))
        if self.selection is None:
            edited = self.operation.apply(asset)
            splats = edited.splats
        elif (exact := self.operation.apply_selected(asset, work.selected(self.selection))) is not None:
            edited, splats = exact, exact.splats
        else:
            edited = self.operation.apply(asset)
            splats = mixed(work.selected(self.selection), below, edited.splats)
        note = "" if edited.receipt is None else edited.receipt.note
        return LayerResult(between(below, without_source(splats)), {"note": note} if note else {})

    def glance(self, work: LayerWork) -> np.ndarray | None:
        sh = self.operation.glance(without_source(work.splats))
        if sh is None or self.selection is None:
            return sh
        return mix_sh(work.splats.sh[:, :1], sh, work.selected(self.selection), "normal")
