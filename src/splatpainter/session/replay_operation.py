"""The layers of a project as an operation (operations/): painted anew on an asset that stands where the project's does.

    sp.edit(splats, [sp.ReplayLayers("brand.splatproj"), sp.Grade(exposure=0.2)])

Sessions stand above operations, which know this kind by its dotted name alone (operation.KINDS).
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from splatpainter.operations.operation import AS_PYTHON, Operation, ReadyOperation, Report, Tools, Wording, parameter
from splatpainter.painter import Asset, Painter
from splatpainter.receipts import Receipt
from splatpainter.session.document.document import Layer, Policy
from splatpainter.session.session import Session
from splatpainter.splats import Splats, changed_rows
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class ReplayLayers(Operation):
    """Paint the visible layers of a project of the studio anew: same pictures, same cameras, in their order, with the
    winners that it names where layers disagree. ASSET has to stand where the project's does."""

    kind: ClassVar[str] = "replay"

    project: Path | None = parameter(None, metavar="PROJECT.splatproj", positional=True, file=True)
    """The project."""
    only: tuple[str, ...] = parameter((), metavar="NAME ...")
    """Names of layers; default: all that are visible."""
    asset: str = parameter("", metavar="NAME|NUMBER", option="layers_of")
    """Asset of a project with several: the name of the one whose layers are meant, or its number (1: the first)."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        if self.project is None:
            raise wording.error(self.kind, f"expected {wording.option('project')}, the project with the layers")

    def ready(self, tools: Tools) -> ReadyOperation:
        layers = self._layers()

        def replayed(asset: Asset, report: Report) -> Asset:
            # On the project's own asset the results are in the project, and nothing has to be painted anew.
            done = self._stored(asset.splats) if layers.is_all and asset.splats.sha256 == layers.sha256 else None
            splats, receipt = done or layers.painted_on(asset.splats, tools.painter)
            # What the file holds beside its Gaussians is that of the asset, not of a session's copy of it.
            splats = replace(splats, source=asset.splats.source, origin=_origin(splats, asset.splats))
            # The first asset stays beside the new one: its surface is what operations after this one work on.
            return Asset(splats, receipt, original=asset.original or asset.splats)

        return replayed

    def _layers(self) -> ProjectLayers:
        """The layers, out of the project. Raises ValueError: no project, no such layers."""
        # Read only: the project may be open in the studio.
        assert self.project is not None
        with Session.load(self.project, readonly=True) as source, tempfile.TemporaryDirectory() as folder:
            layers = [layer for layer in source.layers if layer.asset == self._asset_of(source)]
            # Names that are missing are told, or a layer would be left out without a word.
            missing = sorted(set(self.only) - {layer.name for layer in layers})
            chosen = [layer for layer in layers if layer.visible and (not self.only or layer.name in self.only)]
            if missing or not chosen:
                names = ", ".join(missing) or "so"
                raise ValueError(f"{self.project}: expected visible layers, got none called {names}")
            # As files, by which people carry layers from project to project.
            files = []
            for layer in chosen:
                path = Path(folder) / "one.splatlayer"
                source.files.export_layer(layer.id, path, overwrite=True)
                files.append(path.read_bytes())
            return ProjectLayers(
                str(self.project),
                tuple(chosen),
                tuple(files),
                source.snapshot.document.policies,
                not self.only,
                source.scene.original_of(self._asset_of(source)).sha256,
            )

    def _stored(self, splats: Splats) -> tuple[Splats, Receipt] | None:
        """What the layers make of the project's own asset, and its receipt; None: these are other Gaussians."""
        assert self.project is not None
        with Session.load(self.project, readonly=True) as source:
            asset = self._asset_of(source)
            original = source.scene.original_of(asset)
            # One file read with other axes has the same hash, and layers would paint anywhere on it.
            same = len(original) == len(splats) and original.offset == splats.offset
            if not same or len(changed_rows(original, splats)):
                return None
            alone = asset if len(source.scene.assets) > 1 else None
            return source.files.exported(asset=alone), source.files.receipt(asset=alone)

    def _asset_of(self, source: Session) -> str:
        """The id of the asset whose layers are meant. Raises ValueError: several, and none of them named."""
        for number, one in enumerate(source.scene.assets, 1):
            # By name or by number: names need not be unique, and one asset needs neither.
            if self.asset in (one.name, str(number)) or (not self.asset and len(source.scene.assets) == 1):
                return one.id
        names = ", ".join(repr(one.name) for one in source.scene.assets)
        raise ValueError(f"{self.project}: expected asset to be one of {names}, got {self.asset!r:.80}")


def _origin(replayed: Splats, asset: Splats) -> np.ndarray | None:
    """[N] int64: rows of the asset's file that Gaussians of a session over the asset come from, -1 where there is none;
    None: nobody knows them, and the file is written as a new one."""
    if replayed.origin is None or asset.origin is None:
        return None
    return np.where(replayed.origin >= 0, asset.origin[np.maximum(replayed.origin, 0)], -1)


@dataclass(frozen=True)
class ProjectLayers:
    """Layers out of a project."""

    project: str
    layers: tuple[Layer, ...]
    files: tuple[bytes, ...]
    """Of each its .splatlayer, with its pictures."""
    policies: tuple[tuple[str, str, Policy], ...]
    """(lower, upper, who wins) by the ids that layers have in the project."""
    is_all: bool
    """Whether these are all visible layers of their asset."""
    sha256: str
    """Of the asset that they are of."""

    def painted_on(self, splats: Splats, painter: Painter | None) -> tuple[Splats, Receipt]:
        """(the Gaussians with the layers, the receipt). Raises ValueError naming a layer that cannot be applied."""
        with Session(replace(splats, origin=None), painter=painter) as session, tempfile.TemporaryDirectory() as folder:
            ids: dict[str, str] = {}
            for layer, data in zip(self.layers, self.files, strict=True):
                path = Path(folder) / "one.splatlayer"
                path.write_bytes(data)
                try:
                    new = session.files.import_layer(path)
                except ValueError as error:
                    reason = str(error).removeprefix(f"{path}: ")
                    raise ValueError(f"{self.project}: layer {layer.name!r}: {reason}") from None
                ids |= {old.id: copy.id for old, copy in zip(layer.leaves(), new.leaves(), strict=True)}
            # Ids are given anew by the new session; winners of conflicts go by the old ones.
            for lower, upper, policy in self.policies:
                if lower in ids and upper in ids:
                    session.layers.resolve_conflict(ids[lower], ids[upper], policy)
            return session.splats, session.files.receipt()
