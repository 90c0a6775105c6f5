"""RelitLRM (arXiv 2410.06231): rows under a new light from 4 to 8 posed views and an environment map, by diffusion.

No code of it is public: there is a row only for a command of the user's own. The paper gives it the target's
environment map; methods of these tables get relit views instead (Work has no map), so a command gets those.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbench.adapters import alignment, exchange
from splatbench.adapters.config import GUIDE, Section
from splatbench.adapters.plans import Job, Plan, System, link

VIEWS = 8
"""It takes 4 to 8."""


def plan(job: Job) -> Plan:
    """The posed views that the asset was built from, and the relit ones."""
    base = job.work.base
    count = min(job.own.views or VIEWS, len(base))
    chosen = base.take(np.linspace(0, len(base), count, endpoint=False).astype(int))
    exchange.posed(job.inputs / "base", chosen)
    link(job.inputs / "views", Path("base"))
    return Plan(
        edit=(),
        result=job.out / "edited.ply",
        frame=lambda: alignment.ASSET,
        values={"base": str(job.inputs / "base")},
        note=f"sees {count} views in the source light and {len(job.work.step.edited)} relit; no environment map",
    )


def missing(own: Section) -> str:
    """It has no command of its own."""
    if not own.command:
        return f"no code is public: [relitlrm] needs a `command` of your own ({GUIDE})"
    if any("{environment_map}" in word for word in own.command):
        return "the target's environment map is not among what methods are given: use the relit views in {edits}"
    return ""


SYSTEM = System("relitlrm", "RelitLRM", ("relight",), plan, missing=missing)
