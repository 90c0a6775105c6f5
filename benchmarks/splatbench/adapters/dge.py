"""DGE (arXiv 2404.18929): pictures edited together by InstructPix2Pix, then rows optimised on them. Led by text alone.

It reads the asset's PLY and a COLMAP scene, and writes a PLY in the same frame.
"""

from __future__ import annotations

import json

from splatbench.adapters import alignment, exchange, views
from splatbench.adapters.plans import Job, Plan, System, checkout

VIEWS = 48
SIZE = 512
NEEDS = ("launch.py", "configs/dge.yaml", "threestudio", "gaussiansplatting")


def plan(job: Job) -> Plan:
    """Renders of the asset as a COLMAP scene."""
    own = job.own
    cameras = views.rings(job.cube.lo, job.cube.size, own.views or VIEWS, pixels=own.size or SIZE)
    exchange.colmap(job.inputs / "views", job.work.asset, cameras)
    if not own.command:
        checkout(job, "outputs", "edit_cache")
    settings = {
        "data.source": str(job.inputs / "views"),
        "system.gs_source": str(job.inputs / "asset.ply"),
        "system.prompt_processor.prompt": job.prompt,
        "system.cache_dir": "edit",
        "exp_root_dir": str(job.out),
        "tag": "edit",
        "use_timestamp": False,
        "seed": job.seed,
    }
    # Its values are read as YAML, of which JSON is a part.
    words = tuple(f"{key}={json.dumps(value)}" for key, value in settings.items())
    return Plan(
        edit=((own.python, "launch.py", "--config", "configs/dge.yaml", "--train", *words, *own.arguments),),
        result=job.out / "dge" / "edit" / "save" / "last.ply",
        frame=lambda: alignment.ASSET,
        note=f'sees the text "{job.prompt}" alone, not the edited view',
    )


SYSTEM = System("dge", "DGE", ("creative",), plan, NEEDS)
