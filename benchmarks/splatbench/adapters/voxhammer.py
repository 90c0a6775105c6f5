"""VoxHammer (arXiv 2508.19247): an edit in TRELLIS's latents, within a 3D mask, led by an edited picture.

Its inference.py skips Blender where its render folder is filled already; it is filled with renders of the asset itself,
so the system sees the rows and not a mesh made of them. What it makes is a textured mesh (GLB).
"""

from __future__ import annotations

from splatbench.adapters import alignment, exchange, hull
from splatbench.adapters.plans import Job, Plan, System, checkout, one_of

VIEWS = 150
SIZE = 512
NEEDS = ("inference.py", "voxhammer", "trellis", "assets/preset/preset_grid64.ply")


def plan(job: Job) -> Plan:
    """Renders, 64^3 voxels, the edited picture with its mask, and the region as a mesh."""
    own, step = job.own, job.work.step
    views, images, region = job.inputs / "views", job.inputs / "images", job.inputs / "region.glb"
    reached = exchange.reached(job.work.asset, job.cube, step.edited, step.masks)
    vertices, faces = hull.surface(reached)
    hull.write_glb(region, vertices / exchange.TRELLIS_VOXELS - 0.5, faces)  # y up: Blender turns it upright
    exchange.trellis(views, job.work.asset, job.cube, count=own.views or VIEWS, pixels=own.size or SIZE)
    images.mkdir()
    edits = job.inputs / "edits"
    largest = int(step.masks.reshape(len(step.masks), -1).sum(1).argmax())
    for name, source in (("2d_render", "render"), ("2d_edit", "edited"), ("2d_mask", "mask")):
        (images / f"{name}.png").write_bytes((edits / f"{source}_{largest:03d}.png").read_bytes())
    if not own.command:
        checkout(job, "outputs")
    command = (own.python, "inference.py", "--input_model", str(views / "mesh.ply"), "--mask_model", str(region))
    command += ("--image_dir", str(images), "--render_dir", str(views), "--output_dir", str(job.out), *own.arguments)
    return Plan(
        edit=(command,),
        result=job.out / "output.glb",
        frame=lambda: alignment.cube(job.cube.lo, job.cube.size, upright=False),
        values={"region": str(region)},
        note=f"sees the edited view{one_of(job)} and the region in 3D; its textured mesh is scored as dense flat rows",
    )


SYSTEM = System("voxhammer", "VoxHammer", ("creative",), plan, NEEDS)
