"""One photograph's place in a capture: its camera, its lens, its name, and where its file may lie."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterator
from dataclasses import field, replace
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.captures.lenses import Lens, pinhole_window
from splatpainter.io.folders import inside
from splatpainter.kernels.portable import determinant, inverse, matmul, power
from splatpainter.system.quick_dataclass import dataclass

ENDINGS = ("", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff")
"""What a file's name may go on with where a capture names it without its ending (NeRF's scenes, old cameras.json)."""
_SUFFIXES = frozenset(map(str.lower, ENDINGS))
PICTURE_FOLDERS = ("images", "images_2", "images_4", "images_8")
"""Where ns-process-data and INRIA's convert.py put photographs, and smaller copies of them."""
MASK_FOLDERS = ("masks", "masks_2", "masks_4", "masks_8")
"""Where nerfstudio's masks and smaller copies of them are."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's cameras look along -z with y up."""


@dataclass(frozen=True)
class CapturedView:
    """One entry of a capture."""

    name: str
    """The photograph as the file names it; "" where it names none."""
    camera: Camera
    """A pinhole camera of the photograph's size, focal lengths and principal point."""
    lens: Lens | None = None
    """What bends the photograph's lines besides; None: nothing, it is as `camera` says."""
    folders: tuple[Path, ...] = field(default=(), repr=False)
    """Where the photograph may lie; `name` is relative to these."""
    mask: str = ""
    """The picture of its pixels that are to be looked at, as the file names it; "": all are."""

    def pinhole(self, *, all_of_it: bool) -> Camera:
        """The camera of the photograph without its lens (lenses.pinhole_window)."""
        return self.camera if self.lens is None else pinhole_window(self.camera, self.lens, all_of_it=all_of_it)

    def resized(self, width: int, height: int) -> CapturedView:
        """The same view of a photograph of another size."""
        return replace(self, camera=self.camera.resized(width, height))

    def picture(self) -> Path | None:
        """The photograph's file, or a smaller copy of it; None where neither is there."""
        listed = next((path for path in self._candidates() if os.path.isfile(path)), None)
        if listed is not None or not self.name:
            return listed
        # Disks of Windows and Macs do not tell capitals apart, so tables made there need not either.
        name = PurePosixPath(self.name.replace("\\", "/"))
        alike = (inside(folder / name.parent, name.name) for folder in self.folders)
        return next((path for path in alike if os.path.isfile(path)), None)

    def mask_picture(self) -> Path | None:
        """The file of the mask, or a smaller copy of it; None where neither is there."""
        return replace(self, name=self.mask).picture()

    def _candidates(self) -> Iterator[Path]:
        if not self.name:
            return
        full = self.name.replace("\\", "/")
        # As it stands, then as Macs decompose letters, then as links write spaces.
        plain = unquote(full)
        forms = dict.fromkeys(
            (full, *(unicodedata.normalize(form, n) for n in (full, plain) for form in ("NFC", "NFD")))
        )
        for form in forms:
            yield from self._candidates_of(PurePosixPath(form))

    def _candidates_of(self, name: PurePosixPath) -> Iterator[Path]:
        for folder in self.folders:
            for ending in ENDINGS:
                yield folder / (str(name) + ending)
        # Then smaller copies beside: trainers keep them, and originals are often gone.
        for folder in self.folders:
            data = folder.parent if folder.name in (*PICTURE_FOLDERS, "input") else folder
            for copies in MASK_FOLDERS if name.parent.name in MASK_FOLDERS else PICTURE_FOLDERS:
                for ending in ENDINGS:
                    yield data / copies / (name.name + ending)

    def is_called(self, name: str) -> bool:
        """Whether a photograph's name, with or without folders and ending, in any capitals, is this one's. Captures may
        leave the ending out, old cameras.json all behind the first dot."""
        one, other = (_plain_name(text) for text in (self.name, name))
        alike = other.name in (one.name, one.stem) or one.name in (other.stem, other.name.split(".")[0])
        return bool(self.name) and (alike or one.stem == other.stem)

    def is_called_on(self, name: str) -> bool:
        """Whether a picture's name goes on from this photograph's, as programs call another file that is saved of one:
        IMG_12-Edit.tif, "IMG_12 copy.png"."""
        one, other = (_plain_name(text) for text in (self.name, name))
        stem = one.stem if one.suffix in _SUFFIXES else one.name
        rest = other.stem.removeprefix(stem)
        return bool(stem) and rest != other.stem and rest != "" and not rest[0].isalnum()

    def is_meant_by(self, name: str) -> bool:
        """Whether a picture's name is this photograph's, or goes on from it."""
        return self.is_called(name) or self.is_called_on(name)


def _plain_name(name: str) -> PurePosixPath:
    """A name as it is compared: Macs write an umlaut as two characters, others as one; programs of Windows call
    IMG_1.JPG img_1.jpg."""
    return PurePosixPath(unicodedata.normalize("NFC", name.replace("\\", "/")).casefold())


def rigid(pose: np.ndarray, where: str) -> np.ndarray:
    """[4, 4] float64 world to camera of a camera to world [3 or 4, 4] in OpenCV's axes; a scale of its axes is taken
    out. Raises ValueError: another shape, not finite, flat."""
    matrix = np.asarray(pose, np.float64)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"{where}: expected a 4x4 matrix of a camera, got shape {list(matrix.shape)}")
    # Some programs put the scene's scale into the pose: it is divided out, a mirror is refused.
    size = float(determinant(matrix[:3, :3]))
    if not size > 1e-12:
        raise ValueError(f"{where}: expected a rotation in a camera's matrix, got a flat or mirrored one")
    out = np.eye(4)
    out[:3, :3] = inverse(matrix[:3, :3] / power(size, 1 / 3))
    out[:3, 3] = -matmul(out[:3, :3], matrix[:3, 3])
    return out


def posed_camera(
    where: str,
    size: tuple[int, int],
    focals: tuple[float, float],
    center: tuple[float, float],
    world_to_camera: np.ndarray,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Camera:
    """A camera of a file's numbers. Raises ValueError, naming `where`: numbers that make none."""
    try:
        return Camera(*size, *focals, *center, world_to_camera, background)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where}: {error}") from None
