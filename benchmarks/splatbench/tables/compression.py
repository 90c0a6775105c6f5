"""Tab. 4: what Stage I costs. Objects are reconstructed, unedited, and compared with their truth from novel views.

The LRM sees the asset or its base views; rows differ by what becomes of its Gaussians. Figures are over the object's
pixels, against the truth and against the asset itself (what is copied): the second says what the reconstruction loses,
free of what the asset lacks. Numbers of Gaussians before and after are the paper's figure of the two stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup, safe
from splatbench.ground_truth import GroundTruth, build_asset
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.scoring import object_masks, rendered, scored
from splatbench.tables import Column, beside_truth, measures

if TYPE_CHECKING:
    from splatbench.methods import EditResult

COUNTS = ("gaussians_before", "voxels", "gaussians_kept")
"""Keys of EditResult.numbers; the asset as it is has none of them."""


class Compression:
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
        truth = GroundTruth.load(key.name, key.settings["light"], setup)
        rng = generator(setup.seed, "compress", key.name)
        ring, novel = truth.ring(setup.base_views, rng), truth.ring(setup.novel_views, rng)
        base = truth.render(ring, "base")
        images = truth.render(novel, "compress").images
        asset = build_asset(truth, base)
        return Case(
            protocol=self.name,
            name=key.name,
            label=key.label,
            asset=asset.splats,
            base=base.images,
            steps=(EditStep("global", "plain", base.images, base.masks),),
            before=images,
            after=images,
            near=np.zeros(len(novel), bool),
            setup_seconds=asset.seconds,
            facts={**truth.facts, "asset": asset.method, "light": truth.light.name, "views": len(ring)},
        )

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        """Also Gaussians kept per Gaussian before."""
        last, masks = results[-1], object_masks(case.after)
        figures = scored(last.splats, case.after, masks, perceptual)
        copied = PosedImages(case.after.cameras, rendered(case.asset, case.after.cameras))
        figures["psnr_asset"] = scored(last.splats, copied, masks, None)["psnr"]
        counts = {name: last.numbers.get(name) for name in COUNTS}
        before, remaining = counts["gaussians_before"], counts["gaussians_kept"]
        return figures | counts | {"share_kept": remaining / before if before and remaining is not None else None}

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        return beside_truth(case, results, 0)


TABLE = Compression()
