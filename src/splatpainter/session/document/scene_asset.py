"""One asset of a session that holds several: what it is, where it stands, and how a project keeps its file.

Layers name the asset that they belong to. They live in that asset's own space, so that they go with it wherever it is
moved; the first asset, which the session was opened with, has the id MAIN_ASSET_ID.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any

from splatpainter.io import AXES_CHOICES
from splatpainter.io.files import printable
from splatpainter.io.positions import NO_OFFSET, Offset
from splatpainter.scene.placement import Placement
from splatpainter.splats import MAX_MAGNITUDE, Axes
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

MAIN_ASSET_ID = ""
"""Id of the asset that a session was opened with."""
MAX_ASSETS = 32
"""Most assets of a session."""
MAX_NAME = 200
"""Characters."""


@dataclass(frozen=True)
class SceneAsset:
    """An asset in its scene."""

    id: str
    """Unique within the project, never used again."""
    name: str
    """Name for people."""
    placement: Placement = field(default_factory=Placement)
    visible: bool = True
    file: str = ""
    """Name of its file; of MAIN_ASSET_ID "": the project's facts name it."""
    sha256: str = ""
    """Hash of the asset's file."""
    axes: Axes = "auto"
    """Axes with which its file is read."""
    offset: Offset = NO_OFFSET
    """What its positions are relative to (Splats.offset), as they were when it was added: so layers hold them."""

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and 0 < len(self.name) <= MAX_NAME and self.name.isprintable()):
            raise ValueError(f"asset: expected a name of 1 to {MAX_NAME} characters, got {brief(self.name)}")

    def record(self) -> dict[str, Any]:
        """JSON object of all fields."""
        record: dict[str, Any] = {name: getattr(self, name) for name in ("id", "name", "visible", "file", "sha256")}
        record |= {"frame": self.axes, "placement": self.placement.record()}
        return record | {"offset": list(self.offset)} if any(self.offset) else record

    @staticmethod
    def parse(data: Any) -> SceneAsset:
        """The inverse of `record`. Raises ValueError."""
        try:
            texts = {name: data[name] for name in ("id", "name", "file", "sha256", "frame")}
            # Every field is judged, as the project may be a stranger's.
            if not all(isinstance(text, str) and len(text) <= MAX_NAME for text in texts.values()):
                raise ValueError("expected texts")
            if not isinstance(data["visible"], bool) or texts["frame"] not in AXES_CHOICES:
                raise ValueError("expected visible as a truth value, and axes")
            if texts["id"] != MAIN_ASSET_ID and not (
                len(texts["sha256"]) == 64 and set(texts["sha256"]) <= set("0123456789abcdef")
            ):
                raise ValueError("expected the SHA-256 of its file")
            texts["axes"] = texts.pop("frame")
            placement = Placement.from_record(data["placement"])
            x, y, z = data.get("offset", NO_OFFSET)
            if not all(isinstance(one, int | float) and abs(one) <= MAX_MAGNITUDE for one in (x, y, z)):
                raise ValueError("expected three numbers as its offset")
            offset = (float(x), float(y), float(z))
            return SceneAsset(**texts, placement=placement, visible=data["visible"], offset=offset)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"asset: {printable(str(error), 200)}") from None

    @property
    def folder(self) -> str:
        """Beginning of the names under which a project keeps its file."""
        return f"{self.sha256}/"


def parse_assets(records: Any) -> tuple[SceneAsset, ...]:
    """The assets of a step. Raises ValueError: not a list of them, two of one id, too many, no first one."""
    if not isinstance(records, list) or len(records) > MAX_ASSETS:
        raise ValueError(f"expected a list of at most {MAX_ASSETS} assets")
    assets = tuple(SceneAsset.parse(record) for record in records)
    ids = [asset.id for asset in assets]
    # Layers name assets by id: two of one id would leave open which is meant.
    if len(set(ids)) < len(ids) or (ids and ids[0] != MAIN_ASSET_ID):
        raise ValueError("expected assets of different ids, the first one ahead")
    return assets


def changed_asset(assets: Sequence[SceneAsset], asset: str, **values: Any) -> tuple[SceneAsset, ...]:
    """The assets with other values of one. Raises ValueError for an unknown one."""
    find_asset(assets, asset)
    return tuple(replace(one, **values) if one.id == asset else one for one in assets)


def find_asset(assets: Sequence[SceneAsset], asset: str) -> SceneAsset:
    """The asset of this id. Raises ValueError for an unknown one."""
    for one in assets:
        if one.id == asset:
            return one
    ids = ", ".join(repr(one.id) for one in assets)
    raise ValueError(f"asset: expected one of {ids or repr(MAIN_ASSET_ID)}, got {brief(asset)}")
