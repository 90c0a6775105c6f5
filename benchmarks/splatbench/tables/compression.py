"""Tab. 4: what Stage I costs. Objects are reconstructed, unedited, and compared with their truth from novel views.

The LRM sees the asset or its base views; rows differ by what becomes of its Gaussians. Figures are over the object's
pixels, against the truth and against the asset itself (what is copied): the second says what the reconstruction loses,
free of what the asset lacks. Row counts before and after are the paper's figure of the two stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench import assets
from splatbench import ground_truth as ground
from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup, safe
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.scoring import drawn, object_masks, scored
from splatbench.tables import Column, beside_truth, measures
from splatpainter.data import viewpoints

if TYPE_CHECKING:
    from splatbench.methods import EditResult

COUNTS = ("gaussians_before", "voxels", "gaussians_kept")
"""Of EditResult.numbers; the asset as it is has none of them."""


class Compress:
    """See the module; one case per object."""

    name = "compress"
    title = "Voxel compression in Stage I, nothing edited (Tab. 4)"
    columns = (
        *measures("Against the truth"),
        Column("psnr_asset", "PSNR", "Against the asset", "higher"),
        Column("gaussians_before", "Before", "Gaussians", digits=0),
        Column("gaussians_kept", "Kept", "Gaussians", digits=0),
        Column("voxels", "Voxels", "", digits=0),
    )
    split_by = ""

    def keys(self, setup: Setup) -> list[CaseKey]:
        lights = environments(setup).names
        return [
            CaseKey(f"{safe(name)}-compress", name, {"light": drawn_lights(lights, name, 1, setup.seed)[0]})
            for name in objects(setup).names
        ]

    def make(self, key: CaseKey, setup: Setup) -> Case:
        what = ground.subject(key.name, objects(setup).load(key.name), setup)
        light = environments(setup).load(key.settings["light"])
        rng = generator(setup.seed, "compress", key.name)
        optics = ground.optics(setup)
        ring = viewpoints.ring(what.radius, optics, setup.base_views, rng)
        novel = viewpoints.ring(what.radius, optics, setup.novel_views, rng)
        base = ground.show(what, light, ring, setup, "base")
        truth = ground.show(what, light, novel, setup, "compress").pictures
        built = assets.build(what, light, base, setup)
        return Case(
            protocol=self.name,
            name=key.name,
            label=key.label,
            asset=built.splats,
            base=base.pictures,
            steps=(EditStep("global", "plain", base.pictures, base.masks),),
            before=truth,
            after=truth,
            near=np.zeros(len(novel), bool),
            setup_seconds=built.seconds,
            facts={**ground.told(setup), "asset": built.how, "light": light.name, "views": len(ring)},
        )

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        """Also Gaussians kept per Gaussian before."""
        last, masks = results[-1], object_masks(case.after)
        found = scored(last.splats, case.after, masks, perceptual)
        copied = PosedImages(case.after.cameras, drawn(case.asset, case.after.cameras))
        found["psnr_asset"] = scored(last.splats, copied, masks, None)["psnr"]
        counts = {name: last.numbers.get(name) for name in COUNTS}
        before, kept = counts["gaussians_before"], counts["gaussians_kept"]
        return found | counts | {"share_kept": kept / before if before and kept is not None else None}

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        return beside_truth(case, results, 0)


def protocol() -> Compress:
    return Compress()
