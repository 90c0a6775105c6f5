"""What the lift has to beat: plain optimisation of all attributes of the rows an edit reaches, with Adam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.splats import Splats


@dataclass(frozen=True)
class FitOptions:
    """Learning rates are those of 3DGS training, per attribute."""

    steps: int = 30
    rate_means: float = 1.6e-4
    """Relative to the asset's extent."""
    rate_scales: float = 5e-3
    """Of log-scales."""
    rate_quats: float = 1e-3
    rate_opacities: float = 5e-2
    """Of logit-opacities."""
    rate_sh: float = 2e-2
    """Of the constant band; higher bands get a twentieth."""


def fit_rows(
    splats: Splats,
    views: Sequence[tuple[Camera, np.ndarray]],
    rows: np.ndarray,
    options: FitOptions = FitOptions(),
) -> Splats:
    """Optimise the given rows ([M] int64) so that renders match (camera, target [H, W, 3]) views in the L1 sense.
    All other rows keep their bits."""
    import torch

    from splatpainter.render import render

    base = splats.torch()
    index = torch.from_numpy(rows)
    extent = float(np.ptp(splats.means[splats.finite], axis=0).max())
    raw = {
        "means": base.means[index].clone(),
        "scales": base.scales[index].log(),
        "quats": base.quats[index].clone(),
        "opacities": torch.logit(base.opacities[index].clamp(1e-4, 1 - 1e-4)),
        "first": base.sh[index, :1].clone(),
        "rest": base.sh[index, 1:].clone(),
    }
    rates = {
        "means": options.rate_means * extent,
        "scales": options.rate_scales,
        "quats": options.rate_quats,
        "opacities": options.rate_opacities,
        "first": options.rate_sh,
        "rest": options.rate_sh / 20,
    }
    for value in raw.values():
        value.requires_grad_(True)
    optimizer = torch.optim.Adam([{"params": [raw[name]], "lr": rate} for name, rate in rates.items()], eps=1e-15)

    def current() -> Splats:
        new = {
            "means": raw["means"],
            "scales": raw["scales"].exp(),
            "quats": raw["quats"],
            "opacities": raw["opacities"].sigmoid(),
            "sh": torch.cat([raw["first"], raw["rest"]], 1),
        }
        from dataclasses import replace

        return replace(base, **{k: getattr(base, k).index_copy(0, index, v) for k, v in new.items()})

    targets = [torch.from_numpy(np.ascontiguousarray(target, np.float32)) for _, target in views]
    for step in range(options.steps):
        camera = views[step % len(views)][0]
        picture = render(current(), camera).colors[0]
        loss = (picture - targets[step % len(views)]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        fitted = current().numpy()
    # Through log and logit a value may come back one bit off: rows that were not asked for keep theirs.
    from dataclasses import replace

    merged = {}
    for name in ("means", "quats", "scales", "opacities", "sh"):
        values = getattr(splats, name).copy()
        values[rows] = getattr(fitted, name)[rows]
        merged[name] = values
    return replace(splats, **merged)
