"""Truth with paint on it, one edit after another: path traced (paint on the mesh) or of surfels (in their colours).

Paint is a material under the light, not a light of its own: the edited view is a picture of the painted object, so that
what a method is given and what it is judged by agree. Knows no protocol and no method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench import ground_truth as ground
from splatpainter.cameras import Camera

if TYPE_CHECKING:
    from splatbench.cases import Setup
    from splatbench.ground_truth import Shown, Subject
    from splatpainter.data.edits.layers import PaintCoverage
    from splatpainter.data.lights import Light


@dataclass(frozen=True)
class Tint:
    """A recolouring of what is like a spot and near it (data.edits.layers.Recoloring)."""

    spot: np.ndarray
    """[3] world."""
    radius: float
    """World units."""
    seed: int

    def coat(self, points: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(display colours [M, 3], coverage [M]) at points [M, 3] with display colours `own` [M, 3]; the point next to
        the spot says what is alike."""
        import torch

        from splatpainter.data.edits.layers import Recoloring

        colors, means = (torch.from_numpy(np.asarray(x, np.float32)) for x in (own, points))
        coat = Recoloring(self.spot, self.radius, self.seed).paint(means, colors)
        return coat.colors.numpy(), coat.coverage.numpy()


@dataclass(frozen=True)
class Paint:
    """One edit, made in one view."""

    kind: str
    camera: Camera
    what: np.ndarray | Tint = field(repr=False)
    """[H, W, 4] a layer over the view, display colours and coverage; or a recolouring."""

    @property
    def region(self) -> np.ndarray:
        """[H, W] bool where it may lie in its view."""
        if isinstance(self.what, np.ndarray):
            return self.what[..., 3] > 0
        from splatpainter.data.mesh_visibility import projected

        x, y, z = projected(self.what.spot[None], self.camera)[0]
        v, u = np.mgrid[: self.camera.height, : self.camera.width] + 0.5
        reach = self.what.radius * self.camera.fx / max(z - self.what.radius, 0.3 * z)
        return (u - x) ** 2 + (v - y) ** 2 < reach**2


@dataclass(frozen=True)
class Truth:
    """A subject in a light, painted or not."""

    subject: Subject
    light: Light = field(repr=False)
    setup: Setup = field(repr=False)
    sh: Any = field(default=None, repr=False)
    """[N, K, 3] torch: the painted surfels' colours; None: unpainted, or path traced."""

    def show(self, cameras: Sequence[Camera], purpose: str) -> Shown:
        """As ground.show; equal cameras and purposes have equal noise, whatever is painted."""
        if self.sh is None:
            return ground.show(self.subject, self.light, cameras, self.setup, purpose)
        from splatbench.cases import PosedImages
        from splatpainter.data.lit_scenes import render_views
        from splatpainter.data.surfels import to_splats

        shots = render_views(to_splats(self.subject.surfels, self.sh), cameras)  # type: ignore[arg-type]
        colors, alphas, depths = (x.numpy() for x in (shots.views.colors, shots.alphas, shots.depths))
        return ground.Shown(PosedImages(tuple(cameras), colors), alphas, depths)

    def painted(self, paint: Paint) -> Truth:
        """With one more edit. Raises ValueError as data.edits.on_mesh.repaint_mesh."""
        if self.subject.surfels is None:
            return replace(self, subject=replace(self.subject, mesh=self._painted_mesh(paint)))
        from splatpainter.data.edits.on_surfels import apply_paint
        from splatpainter.data.lights import shade

        sh = shade(self.subject.surfels, self.light, ground.DEGREE) if self.sh is None else self.sh
        return replace(self, sh=apply_paint(sh, self._coat(paint, sh)))

    def rough(self) -> Truth:
        """For choices: the same, unpainted, of few surfels; itself where it is of surfels."""
        if self.subject.surfels is not None:
            return self
        from splatpainter.data.surfels import sample_surfels

        surfels = sample_surfels(self.subject.mesh, ground.FEWEST, self.setup.seed)
        return replace(self, subject=replace(self.subject, surfels=surfels))

    def _painted_mesh(self, paint: Paint) -> Any:
        from splatpainter.data.edits import EditDesign
        from splatpainter.data.edits.layers import Recoloring
        from splatpainter.data.edits.on_mesh import paint_mesh

        what = paint.what
        content = what if isinstance(what, np.ndarray) else Recoloring(what.spot, what.radius, what.seed)
        return paint_mesh(self.subject.mesh, EditDesign(paint.kind, paint.camera, content))

    def _coat(self, paint: Paint, sh: Any) -> PaintCoverage:
        """What the painting view shows of the edit, on the surfels."""
        import torch

        from splatpainter.data.edits import on_surfels
        from splatpainter.data.edits.layers import PaintCoverage
        from splatpainter.data.lights import shade
        from splatpainter.data.lit_scenes import render_views
        from splatpainter.data.surfels import to_splats

        surfels, camera = self.subject.surfels, paint.camera
        assert surfels is not None
        if isinstance(paint.what, np.ndarray):
            layer = torch.from_numpy(np.ascontiguousarray(paint.what, np.float32))
            colors, coverage = on_surfels.project_layer(layer, camera, surfels.means)
            plain = shade(surfels, self.light, ground.DEGREE)  # what is painted already says nothing about the light
            colors = on_surfels.shade_paint(colors, plain, surfels.albedo)
        else:
            own = on_surfels.display_colors(sh).numpy()
            colors, coverage = (torch.from_numpy(x) for x in paint.what.coat(surfels.means.numpy(), own))
        shots = render_views(to_splats(surfels, sh), [camera])
        seen = on_surfels.view_visibility(surfels.means, surfels.normals, camera, shots.depths[0], shots.alphas[0])
        return PaintCoverage(colors, coverage * seen)


def changed(before: Shown, after: Shown) -> np.ndarray:
    """[V, H, W] bool where two truths of equal noise differ (data.edits.change_masks)."""
    return changes(before.pictures.colors, after.pictures.colors)


def changes(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The same of pictures [V, H, W, 3]."""
    import torch

    from splatpainter.data.edits import change_masks

    if not len(before):
        return np.zeros(before.shape[:3], bool)
    one, other = (torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in (before, after))
    return change_masks(one, other).numpy()
