"""How an edit looks from the side: the edited asset from four views about the paint, each against the painted picture
moved there over the asset's own surface.

An edit is given in one view and judged there; whether the paint lies on the surface only other views tell, and nobody
has a picture of them. The nearest to one is the painted picture reprojected: where the surface of the asset *before*
the edit is seen in both views, the side view should change by what the picture changes. Changes are compared and not
colours, so that an asset that looks different from its sides is not blamed on the edit. Small and quick: at most
SIDE_VIEWS.max_side_px a view.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.cameras import Camera, look_at
from splatpainter.kernels import portable
from splatpainter.kernels.parallel import each
from splatpainter.lift.depth_normals import surface
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.masks import box_mean, dilated
from splatpainter.lift.warping import ViewedChange, bilinear, seen_in_both, shrunk
from splatpainter.order_statistics import median
from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

DB_PER_NEPER = 4.342944819032518
"""10 / ln 10: of a ratio of squares."""


@dataclass(frozen=True)
class SideViewThresholds:
    """Views from the side in which an edit is compared with its picture. Source: taste."""

    side_degrees: float = 35.0
    """Degrees between the edited view and those from the side: left, right, above, below."""
    max_side_px: int = 256
    """Pixels of a side view's edge."""
    margin_px: int = 8
    """Margin of the edited picture, around the mask, pixels."""
    min_alpha: float = 0.5
    """Pixels that the asset covers by less have no surface."""
    min_edited: float = 0.25
    """Share of a small pixel that was edited, to count as painted: less than a half, so that thin strokes do."""
    soft_px: int = 1
    """Reach of the mean by which errors are blurred: half a pixel beside is not worth a word."""
    spill_px: int = 2
    """Pixels around the painted pixels: where they should end is compared too."""
    max_db: float = 60.0
    """Highest score; renders that agree better get this."""


SIDE_VIEWS = SideViewThresholds()


@dataclass(frozen=True)
class SideViewScore:
    """Score of an edit seen from the side."""

    psnr: float | None
    """dB of the painted pixels and their rim in all side views together; None where none can be compared."""
    covered: float
    """Share of the painted pixels that a side view can check, mean over the views, 0..1."""


def side_view_score(before: Splats, after: Splats, view: EditView) -> SideViewScore:
    """before, after: numpy, the asset without and with the edit of `view`.

    On paint over 24 meshes that training never saw, by three methods (`splatpainter bench painted`), this ranks edits
    as the true novel views do: Spearman 0.90 with their PSNR, 0.85 with that after a blur of 2 px; among the methods on
    one object 0.83 and 0.85. On six that 3DGS fitted 0.85 and 0.82 (0.50 and 0.67), on 16 procedural ones that had no
    part in the choice 0.81 and 0.58 (0.72 and 0.69). Without rim and blur 0.89 and 0.78 on the first; with the expected
    depth as surface 0.65 and 0.66."""
    pairs = side_views(before, after, view)
    covered = float(np.mean([pair.covered for pair in pairs])) if pairs else 0.0
    # All side views are one sample: a view that sees little counts little.
    errors = np.concatenate([np.zeros((0, 3)), *(pair.soft_errors for pair in pairs)])
    if not len(errors):
        return SideViewScore(None, covered)
    return SideViewScore(
        min(DB_PER_NEPER * portable.log(1 / max(float((errors**2).mean()), 1e-12)), SIDE_VIEWS.max_db), covered
    )


@dataclass(frozen=True)
class SideView:
    """One view from the side, H x W pixels."""

    expected: np.ndarray
    """[H, W, 3] what it should show."""
    image: np.ndarray
    """[H, W, 3] what it shows, in the tiles of the painted pixels and their rim; elsewhere the background."""
    unpainted: np.ndarray
    """[H, W, 3] what the asset without the edit shows."""
    painted: Bools
    """[H, W] bool painted pixels that both views see."""
    covered: float
    """Share of the painted pixels of the edited view that this one sees."""

    @property
    def soft_errors(self) -> np.ndarray:
        """[K, 3] blurred difference of `image` and `expected`, of the painted pixels and SIDE_VIEWS.spill_px around
        them."""
        return box_mean(self.image - self.expected, SIDE_VIEWS.soft_px)[dilated(self.painted, SIDE_VIEWS.spill_px)]


def side_views(before: Splats, after: Splats, view: EditView) -> list[SideView]:
    """Side views from SIDE_VIEWS.side_degrees left, right, above and below; none where no edited pixel has a
    surface."""
    window = _Window.of(before, view)
    if window is None:
        return []
    cameras = [window.turned(*turn) for turn in ((-1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, -1.0))]
    return each(lambda camera: window.seen_from(before, after, camera), cameras)


@dataclass(frozen=True)
class _Window:
    """The part of the edited picture around the mask, small."""

    edit: ViewedChange
    center: np.ndarray
    """[3] of the painted surface."""

    @staticmethod
    def of(splats: Splats, view: EditView) -> _Window | None:
        """None where no edited pixel has a surface."""
        rows, columns = (np.flatnonzero(view.mask.any(axis)) for axis in (1, 0))
        top, left = max(int(rows[0]) - SIDE_VIEWS.margin_px, 0), max(int(columns[0]) - SIDE_VIEWS.margin_px, 0)
        height = min(int(rows[-1]) + 1 + SIDE_VIEWS.margin_px, view.camera.height) - top
        width = min(int(columns[-1]) + 1 + SIDE_VIEWS.margin_px, view.camera.width) - left
        part = (slice(top, top + height), slice(left, left + width))
        mask = view.mask[part].astype(np.float32)
        change = (view.edited[part] - view.before[part]) * mask[..., None]
        # Shrunk to the size at which side views are compared, with the camera to match.
        factor = -(-max(height, width) // SIDE_VIEWS.max_side_px)
        mask, change = shrunk(mask, factor), shrunk(change, factor)
        height, width = mask.shape
        camera = view.camera.cropped(left, top, width * factor, height * factor).resized(width, height)
        projected = project(splats, camera)
        alpha = projected.rasterize()[1]
        depth = surface(projected, dilated(mask > 0, SIDE_VIEWS.margin_px))[0]
        mask = mask * (depth > 0) * (alpha > SIDE_VIEWS.min_alpha)
        if not (mask > SIDE_VIEWS.min_edited).any():
            return None
        # Side cameras turn about the middle of the paint.
        center = median(camera.unproject(depth)[mask > SIDE_VIEWS.min_edited])
        return _Window(ViewedChange(camera, change, mask, depth), center)

    def turned(self, right: float, up: float) -> Camera:
        """The painted part from another side at the same distance; turns in SIDE_VIEWS.side_degrees."""
        axes = self.edit.camera.world_to_camera[:3, :3]
        offset = self.edit.camera.position - self.center
        towards = portable.sin(math.radians(SIDE_VIEWS.side_degrees)) * (right * axes[0] - up * axes[1])
        distance = portable.length(offset)
        eye = portable.cos(math.radians(SIDE_VIEWS.side_degrees)) * offset / distance + towards
        size = max(self.edit.camera.width, self.edit.camera.height)
        fov = math.degrees(2 * portable.arctan2(size / 2, self.edit.camera.fy))
        upwards = -axes[1] if not up else -axes[1] - up * self.edit.camera.forward
        background = self.edit.camera.background
        eye = self.center + distance * eye / portable.length(eye)
        return look_at(eye, self.center, upwards, width=size, height=size, fov=fov, background=background).local

    def seen_from(self, before: Splats, after: Splats, camera: Camera) -> SideView:
        """What should be seen from there, and what is."""
        view = project(before, camera)
        unpainted, alpha, expected = view.rasterize()
        # Where the surface matters: in reach of the mask, by the expected depth, which is at hand.
        pixels, _ = self.edit.camera.project(camera.unproject(np.where(alpha > SIDE_VIEWS.min_alpha, expected, 1)))
        near = bilinear(self.edit.mask[..., None], pixels)[..., 0] > 0
        depth = surface(view, dilated(near & (alpha > SIDE_VIEWS.min_alpha), SIDE_VIEWS.margin_px))[0]
        depth = np.where(alpha > SIDE_VIEWS.min_alpha, depth, 0)
        # Expected is the unedited view plus the change, moved over the old surface.
        moved = self.edit.moved(camera, depth)
        painted = moved[..., 3] > SIDE_VIEWS.min_edited
        compared = tiles_of_mask(dilated(painted, SIDE_VIEWS.spill_px + SIDE_VIEWS.soft_px))
        image = project(after, camera, tiles=compared).rasterize()[0]
        seen = seen_in_both(camera, depth, self.edit.camera, self.edit.depth) & (self.edit.mask > SIDE_VIEWS.min_edited)
        covered = float(seen.sum() / (self.edit.mask > SIDE_VIEWS.min_edited).sum())
        return SideView(unpainted + moved[..., :3], image, unpainted, painted, covered)
