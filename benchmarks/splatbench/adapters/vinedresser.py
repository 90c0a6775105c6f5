"""VineDresser3D (arXiv 2602.19542): an edit in TRELLIS's latents, the region found by language models from a text.

Its main.py asks for nothing that is in its outputs folder already, so that folder is filled with renders of the asset
itself (in place of Blender's of a mesh) and with the edited view (in place of one made by an image model: the paper
gives both systems the same edited picture). It saves latents; decode_slat.py turns them into rows.
"""

from __future__ import annotations

import os
from pathlib import Path

from splatbench.adapters import alignment, exchange
from splatbench.adapters.config import Section
from splatbench.adapters.plans import Job, Plan, System, checkout, one_of

NAME = "asset"
VIEWS = 150
SIZE = 512
PICTURE = 518
"""Pixels; of the edited picture."""
NEEDS = ("main.py", "encode_asset/encode_into_SLAT.py", "PartField", "trellis")
OWN = ("outputs", "data", "PartField/data", "PartField/clustering_results", "PartField/partfield_features")
"""Folders that it writes to."""
KEYS = ("GEMINI_API_KEY", "GOOGLE_API_KEY")
ENCODE = f"from encode_asset.encode_into_SLAT import encode_into_SLAT; encode_into_SLAT({NAME!r})"


def plan(job: Job) -> Plan:
    """A workplace with the outputs of its first steps."""
    from PIL import Image

    own = job.own
    if not own.command:
        checkout(job, *OWN)
    outputs = job.workplace / "outputs"
    for name in ("img_edit/ID", "img_edit/img", "slat"):
        (outputs / name).mkdir(parents=True, exist_ok=True)
    (job.workplace / "PartField" / "clustering_results" / "ply").mkdir(parents=True, exist_ok=True)
    views = outputs / "img_Enc" / NAME
    exchange.trellis(views, job.work.asset, job.cube, count=own.views or VIEWS, pixels=own.size or SIZE)
    masks = job.work.step.masks
    largest = int(masks.reshape(len(masks), -1).sum(1).argmax())
    with Image.open(job.inputs / "edits" / f"edited_{largest:03d}.png") as edited:
        picture = edited.resize((PICTURE, PICTURE), Image.Resampling.LANCZOS)
    picture.save(outputs / "img_edit" / "img" / f"{NAME}_editedImg.png")
    exchange.save_text(outputs / "img_edit" / "ID" / f"{NAME}_editImgID.txt", "0")
    latents = [str(outputs / "slat" / f"{NAME}_edited_{part}.pt") for part in ("feats", "coords")]
    decode = (Path(__file__).parent / "decode_slat.py").read_text(encoding="utf-8")
    result = job.out / "edited.ply"
    edit = (own.python, "main.py", "--input_file", f"{NAME}.glb", "--editing_prompt", job.prompt, *own.arguments)
    return Plan(
        setup=((own.python, "-c", ENCODE),),
        edit=(edit,),
        export=((own.python, "-c", decode, *latents, str(result)),),
        result=result,
        frame=lambda: alignment.cube(job.cube.lo, job.cube.size, upright=True),
        values={"views": str(views)},
        note=f'sees the edited view{one_of(job)} and the text "{job.prompt}"; it finds the region itself',
    )


def missing(own: Section) -> str:
    """It asks Google's models over the network, and its number of views is fixed."""
    if own.views not in (0, VIEWS) and not own.command:
        return f"[vinedresser3d] views: its main.py reads {VIEWS}, got {own.views}"
    if own.command or any(os.environ.get(key) or own.environment.get(key) for key in KEYS):
        return ""
    return f"needs a key for Google's models: set {' or '.join(KEYS)} in the environment"


SYSTEM = System("vinedresser3d", "VineDresser3D", ("creative",), plan, NEEDS, missing)
