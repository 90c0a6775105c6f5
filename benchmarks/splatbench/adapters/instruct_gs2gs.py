"""Instruct-GS2GS: a nerfstudio plug-in that edits training pictures by InstructPix2Pix while rows are optimised.
Led by text alone.

It starts from a checkpoint of nerfstudio's splatfacto, not from rows: set-up trains one on renders of the asset.
"""

from __future__ import annotations

import re
from pathlib import Path

from splatbench.adapters import alignment, exchange, views
from splatbench.adapters.plans import Job, Plan, System

VIEWS = 48
SIZE = 512
SETUP_STEPS = 20_000
"""As its README says."""
GUIDANCE, IMAGE_GUIDANCE = "12.5", "1.5"


def plan(job: Job) -> Plan:
    """Renders of the asset as a nerfstudio dataset."""
    own, out = job.own, job.out
    cameras = views.rings(job.cube.lo, job.cube.size, own.views or VIEWS, pixels=own.size or SIZE)
    exchange.nerfstudio(job.inputs / "views", job.work.asset, cameras)

    def train(method: str, experiment: str) -> tuple[str, ...]:
        place = ("--output-dir", str(out), "--experiment-name", experiment, "--timestamp", "run")
        end = ("--viewer.quit-on-train-completion", "True", "--machine.seed", str(job.seed))
        black = ("--pipeline.model.background-color", "black")
        words = (own.python, "-m", "nerfstudio.scripts.train", method, "--data", str(job.inputs / "views"))
        return (*words, *place, *end, *black)

    start, edited = out / "setup" / "splatfacto" / "run" / "nerfstudio_models", out / "edit" / "igs2gs" / "run"
    guide = ("--pipeline.guidance-scale", GUIDANCE, "--pipeline.image-guidance-scale", IMAGE_GUIDANCE)
    edit = (*train("igs2gs", "edit"), "--load-dir", str(start), "--pipeline.prompt", job.prompt, *guide)
    export = (own.python, "-m", "nerfstudio.scripts.exporter", "gaussian-splat")
    return Plan(
        setup=((*train("splatfacto", "setup"), "--max-num-iterations", str(SETUP_STEPS), *own.setup_arguments),),
        edit=((*edit, *own.arguments),),
        export=((*export, "--load-config", str(edited / "config.yml"), "--output-dir", str(out / "export")),),
        result=out / "export" / "splat.ply",
        frame=lambda: alignment.nerfstudio(edited / "dataparser_transforms.json"),
        check=lambda: trained(start, edited / "nerfstudio_models"),
        note=f'sees the text "{job.prompt}" alone, not the edited view; edits a re-trained copy of the asset',
    )


def trained(start: Path, end: Path) -> None:
    """Raises ValueError where the edit took no step: nerfstudio's releases to 1.1.5 count --max-num-iterations from the
    loaded checkpoint, its main branch since November 2024 from 0, and then 7,500 end before they begin."""
    first, last = latest(start), latest(end)
    if last <= first:
        raise ValueError(
            f"Instruct-GS2GS took no step (last checkpoints: set-up {first}, edit {last}); where nerfstudio counts the "
            'set-up\'s steps too, set arguments = ["--max-num-iterations", "27500"]'
        )


def latest(folder: Path) -> int:
    """Step of the last checkpoint in a folder, -1 where there is none."""
    found = [re.fullmatch(r"step-(\d+)\.ckpt", path.name) for path in folder.glob("step-*.ckpt")]
    return max((int(match[1]) for match in found if match), default=-1)


SYSTEM = System("instruct-gs2gs", "Instruct-GS2GS", ("creative",), plan)
