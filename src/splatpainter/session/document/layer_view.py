"""One edited picture of a layer, and the words that say how a layer mixes with what is below it. Frozen values, JSON.

Pictures and masks are named by the SHA-256 of their PNG bytes; who has the bytes is the project's business.
"""

from __future__ import annotations

from typing import Any, Literal

from splatpainter.cameras import Camera
from splatpainter.image_files import MAX_PICTURE_PIXELS
from splatpainter.system.quick_dataclass import dataclass

Blend = Literal["normal", "color", "luminosity", "darken", "lighten"]
"""How a layer mixes with what is below it (layer_blending.py)."""


@dataclass(frozen=True)
class View:
    """One edited picture of a layer."""

    camera: Camera
    picture: str | None = None
    """Hash of the edited view, a PNG of the camera's size; None where only the mask counts (eraser, adjustments)."""
    mask: str | None = None
    """Hash of the mask, a PNG (white: edited); None: all that the asset covers (mode global)."""

    def record(self) -> dict[str, Any]:
        return {"camera": self.camera.record(), "picture": self.picture, "mask": self.mask}

    @staticmethod
    def parse(data: dict[str, Any], where: str) -> View:
        """The inverse of `record`. Raises ValueError naming `where`, KeyError and TypeError for other values."""
        camera = Camera.from_record(data["camera"], where)
        if camera.width * camera.height > MAX_PICTURE_PIXELS:
            raise ValueError(f"{where}: expected a view of at most {MAX_PICTURE_PIXELS // 10**6} megapixels")
        return View(camera, checked_hash(data["picture"], where), checked_hash(data["mask"], where))


def is_hash(value: Any) -> bool:
    """Whether it is a hex SHA-256, as blobs are named."""
    return isinstance(value, str) and len(value) == 64 and set(value) <= set("0123456789abcdef")


def checked_hash(value: Any, where: str) -> str | None:
    """The hash, or None. Raises ValueError for anything else."""
    if value is None:
        return None
    if not is_hash(value):
        raise ValueError(f"{where}: expected the SHA-256 of a picture, got {value!r:.80}")
    return value
