"""`splatpainter mesh`: a closed triangle mesh that stands for an asset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from splatpainter.color import srgb_to_linear
from splatpainter.commands import Outcome
from splatpainter.commands.parts.asset_doubts import warn_of_doubts
from splatpainter.commands.parts.option_marks import Argument
from splatpainter.commands.parts.option_parsing import AssetFile, InAxesOption
from splatpainter.commands.parts.terminal import count, stages
from splatpainter.extras import require
from splatpainter.image_files import encode_png
from splatpainter.io import files, read
from splatpainter.io.axes import AXES
from splatpainter.io.gltf_mesh import mesh_glb
from splatpainter.output_paths import check_target
from splatpainter.surface.mesh_texture import MAX_TEXTURE_PX, bake_texture
from splatpainter.surface.proxy_mesh import MIN_TRIANGLES, PROXY, proxy_mesh
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config:
    """Make a closed triangle mesh of an asset: what other programs cast its shadows with, or test collisions by.

    It is as fine as the number of triangles allows, without holes; a sheet becomes a slab. Its numbers are those of the
    .glb that `splatpainter convert` makes of the asset, so that both lie in one place.

    example:
      splatpainter mesh vase.ply --out proxy.glb
      splatpainter mesh vase.ply --triangles 5000 --colors --out proxy.glb
      splatpainter mesh vase.ply --triangles 500 --decimate --out light.glb
      splatpainter mesh vase.ply --triangles 5000 --texture 1024 --out preview.glb
    """

    asset: AssetFile
    """The splat file; it is not changed."""
    out: Annotated[Path, Argument(metavar="PROXY.glb")]
    """The file to write."""
    triangles: int = 20_000
    """Triangles, at most about; 2,000 or more, with --decimate 100 or more."""
    decimate: bool = False
    """Cut a finer mesh and collapse its edges where it is flat: more detail for as many triangles, still without holes
    (needs fast-simplification, the extra `mesh`)."""
    colors: bool = False
    """Colours of the asset at the vertices."""
    texture: Annotated[int, Argument(metavar="PX")] = 0
    """The asset's look on the mesh, as a picture of so many pixels inside the file; its triangles then share no
    vertices. 0: none."""
    axes: Literal["rub", "rdf"] = "rub"
    """Axes of the numbers: rub is y up, as glTF wants it; rdf those of a PLY."""
    in_axes: InAxesOption = "auto"
    """Axes of ASSET's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row."""
    overwrite: bool = False
    """Replace OUT if it exists."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Check, read, fill, cut out, write."""
    # Another ending would be taken for another format, and only this one is written.
    if config.out.suffix.lower() != ".glb":
        raise ValueError(f"{config.out}: expected a mesh to write (.glb), got {config.out.suffix or 'no suffix'}")
    least = PROXY.min_decimated if config.decimate else MIN_TRIANGLES
    if config.triangles < least:
        hint = "" if config.decimate else f"; with --decimate {PROXY.min_decimated}"
        raise ValueError(f"splatpainter: expected --triangles of {least} or more{hint}, got {config.triangles}")
    if config.colors and config.texture:
        raise ValueError("splatpainter: expected --colors or --texture, got both")
    if config.texture and not 64 <= config.texture <= MAX_TEXTURE_PX:
        raise ValueError(f"splatpainter: expected --texture from 64 to {MAX_TEXTURE_PX} pixels, got {config.texture}")
    if config.decimate:
        require("fast_simplification", "--decimate")
    # Refused before the asset is read and meshed.
    check_target(config.out, config.overwrite, [config.asset])
    with stages(3) as bar:
        bar.enter("reading")
        splats = read(config.asset, axes=config.in_axes, lenient=config.lenient)
        doubts = warn_of_doubts(splats, config.asset)
        bar.enter("meshing")
        mesh = proxy_mesh(splats, config.triangles, decimate=config.decimate)
        bar.enter("writing")
        # The file's axes are a matter of signs; where they mirror, triangles turn over and are turned back.
        signs = np.array(AXES[config.axes], np.float32)
        triangles = mesh.triangles if signs.prod() > 0 else mesh.triangles[:, ::-1]
        # The offset stays apart, as a translation: the vertices keep small numbers.
        x, y, z = (float(value * sign) for value, sign in zip(splats.offset, signs, strict=True))
        vertices, normals, texture = mesh.vertices, mesh.normals, None
        if config.texture:
            baked = bake_texture(splats, mesh, config.texture)
            corners = mesh.triangles.reshape(-1)
            vertices, normals = vertices[corners], normals[corners]
            texture = (baked.uv.reshape(-1, 2), encode_png(baked.picture))
            triangles = np.arange(len(corners)).reshape(-1, 3)
            triangles = triangles if signs.prod() > 0 else triangles[:, ::-1]
        # glTF wants linear colours at the vertices.
        data = mesh_glb(
            vertices * signs,
            triangles,
            normals * signs,
            srgb_to_linear(mesh.colors) if config.colors else None,
            texture=texture,
            name=config.asset.name.split(".")[0] or "proxy",
            translation=(x, y, z),
        )
        with files.writing(config.out) as file:
            file.write(data)
    record = {
        "input": {"file": config.asset, "rows": len(splats)},
        "output": {
            "file": config.out,
            "bytes": len(data),
            "triangles": len(triangles),
            "vertices": len(vertices),
            "voxel": mesh.voxel,
            "cut_triangles": mesh.cut_triangles,
        },
        "doubts": doubts,
    }
    of = f" of {mesh.cut_triangles:,}" if len(triangles) < mesh.cut_triangles else ""
    lines = [
        f"{config.asset} -> {config.out}",
        f"{count(len(triangles), 'triangle')}{of}, {count(len(vertices), 'vertex', 'vertices')}",
        f"finest detail: {mesh.voxel:.3g} world units",
    ]
    return Outcome(record, lines)
