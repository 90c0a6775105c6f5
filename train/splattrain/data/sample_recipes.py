"""What samples are made of: kinds of edits, sizes, odds. Plain settings, cheap to import; samples.py makes them."""

from __future__ import annotations

from dataclasses import dataclass, field

PAINTED = ("stroke", "text", "sticker", "photo", "noise")
"""Layers over a view."""
LOCAL = ("zoom", *PAINTED, "recolor", "conflict")
GLOBAL = ("relight", "regrade")
KINDS = (*LOCAL, *GLOBAL, "plain")
"""Kinds of samples. "plain": no edit, zero edited views; for training what only looks."""


@dataclass(frozen=True)
class SampleRecipe:
    """What samples are made of. Gaussians and pixels set the cost."""

    kinds: dict[str, float] = field(default_factory=lambda: {"stroke": 1.0})
    """Weight of each kind of edit (see KINDS)."""
    size: int = 128
    """Pixels of every view's edge."""
    rows: int = 8000
    """Gaussians of the asset."""
    surfels: int = 60_000
    """Surfels (dense Gaussians) of the ground truth."""
    detail: tuple[float, float] = (1.0, 1.0)
    """Resolution factor, drawn per object, log-uniform: times `size`; its square times Gaussians and surfels."""
    fuzz: tuple[float, float] = (0.1, 0.5)
    """How rough the asset is, drawn per object; see surfels.coarse_asset."""
    sh_degree: int = 1
    """SH degree of asset and truth: 0 (matt) to 2."""
    views: tuple[float, ...] = (0.4, 0.3, 0.15, 0.15)
    """Odds of 1, 2, 3, 4 edited views (conflicts have two)."""
    base_views: int = 6
    """Views of the unedited truth around the object, the same for all samples of a stage."""
    novel_views: int = 4
    """Views for the loss; the first half near the edit."""
    share: tuple[float, float] = (0.03, 0.25)
    """Part of the first edited view that paint covers."""
    window: tuple[float, float] = (0.7, 1.7)
    """Height of a local edit's close-up, in radii of the object."""
    zoom: tuple[float, float] = (2.0, 4.0)
    """Magnification of zoom-in tiles over a view of the whole object."""
    lit_paint: float = 0.4
    """How often paint is shaded by the light that falls on it; otherwise it shows as it was painted."""
    fov: tuple[float, float] = (30.0, 55.0)
    """Vertical field of view, degrees, drawn per stage."""
    backgrounds: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))
    """Background colours; one of them per stage."""
    steps_per_object: int = 8
    """Samples of one stage (object, light, asset) before the next."""

    def __post_init__(self) -> None:
        unknown = sorted(set(self.kinds) - set(KINDS))
        if unknown or not self.kinds or min(self.kinds.values()) < 0 or sum(self.kinds.values()) <= 0:
            raise ValueError(f"recipe: expected kinds of {', '.join(KINDS)} with weights >= 0, got {self.kinds}")
        least = {"size": 16, "rows": 16, "surfels": 64, "base_views": 1, "novel_views": 1, "steps_per_object": 1}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ValueError(f"recipe: expected {name} of at least {bound}, got {getattr(self, name)}")
        if self.rows > self.surfels:
            raise ValueError(
                f"recipe: expected no more rows than surfels, of which assets are made, got {self.rows:,} rows and "
                f"{self.surfels:,} surfels"
            )
        if not 0 < self.detail[0] <= self.detail[1]:
            raise ValueError(f"recipe: expected a detail of two rising factors above 0, got {self.detail}")
        if not 1 <= len(self.views) <= 16 or min(self.views) < 0 or sum(self.views) <= 0:
            raise ValueError(f"recipe: expected odds >= 0 of 1, 2, ... up to 16 edited views, got {self.views}")
        if self.sh_degree not in (0, 1, 2):
            raise ValueError(f"recipe: expected sh_degree 0, 1 or 2, got {self.sh_degree}")
        if not self.backgrounds:
            raise ValueError("recipe: expected at least one background colour, got none")


_LOCAL: dict[str, float] = {
    "zoom": 3,
    "stroke": 3,
    "text": 2,
    "sticker": 2,
    "photo": 1.5,
    "noise": 1,
    "recolor": 2,
    "conflict": 1,
}
_GLOBAL: dict[str, float] = {"relight": 3, "regrade": 1}


def _normalized(*parts: dict[str, float]) -> dict[str, float]:
    """The parts with equal sums."""
    return {kind: weight / sum(part.values()) for part in parts for kind, weight in part.items()}


RECIPES: dict[str, SampleRecipe] = {
    "local": SampleRecipe(_normalized(_LOCAL)),
    "global": SampleRecipe(_normalized(_GLOBAL), views=(0.3, 0.3, 0.2, 0.2)),
    "unified": SampleRecipe(_normalized(_LOCAL, _GLOBAL)),
    "lrm": SampleRecipe({"plain": 1.0}, base_views=8, steps_per_object=2),
    "paper": SampleRecipe(
        _normalized(_LOCAL, {"plain": 1}),
        size=512,
        rows=60_000,
        surfels=400_000,
        sh_degree=2,
        views=(0.25, 0.25, 0.25, 0.25),
        base_views=16,
    ),
}
"""Starting points; change sizes with dataclasses.replace. "local" and "global": one model each, as in the paper;
"unified": both in equal parts; "lrm": views and novel views without edits, and objects that change quickly; "paper":
what all stages of the recipes `paper` read, in one folder of shards."""
