"""SplatPainter: edit a picture of a 3D Gaussian asset, and the asset changes; untouched Gaussians keep every bit.

Names are imported on first use, so `import splatpainter` costs nothing and needs no torch.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from splatpainter._version import __version__ as __version__

if TYPE_CHECKING:
    from splatpainter.cameras import Camera as Camera
    from splatpainter.cameras import look_at as look_at
    from splatpainter.cameras import orbit as orbit
    from splatpainter.decals.decals import Decal as Decal
    from splatpainter.editing import edit as edit
    from splatpainter.grading.color_grading import GradeSettings as GradeSettings
    from splatpainter.grading.color_match import ColorMatch as ColorMatch
    from splatpainter.grading.color_match import Recolor as Recolor
    from splatpainter.grading.cube_lut import read_cube as read_cube
    from splatpainter.io import read as read
    from splatpainter.io import write as write
    from splatpainter.io.write_options import WriteOptions as WriteOptions
    from splatpainter.lights.lamps import Lamp as Lamp
    from splatpainter.lights.lamps import Sun as Sun
    from splatpainter.lights.light_set import Lights as Lights
    from splatpainter.lights.relight import delight as delight
    from splatpainter.lights.relight import light as light
    from splatpainter.lights.skies import sky as sky
    from splatpainter.lights.sky_maps import read_sky as read_sky
    from splatpainter.operations.decal import LayDecal as LayDecal
    from splatpainter.operations.fill import Fill as Fill
    from splatpainter.operations.generate import Generate as Generate
    from splatpainter.operations.grade import Grade as Grade
    from splatpainter.operations.grade import adjust as adjust
    from splatpainter.operations.grade import grade as grade
    from splatpainter.operations.light import Delight as Delight
    from splatpainter.operations.light import Relight as Relight
    from splatpainter.operations.paint import Paint as Paint
    from splatpainter.operations.pixelate import Pixelate as Pixelate
    from splatpainter.operations.pixelate import pixelate as pixelate
    from splatpainter.operations.refine import Refine as Refine
    from splatpainter.operations.region import Region as Region
    from splatpainter.operations.to_file import apply_to_file as apply_to_file
    from splatpainter.painter import Asset as Asset
    from splatpainter.painter import Edit as Edit
    from splatpainter.painter import Painter as Painter
    from splatpainter.receipts import Receipt as Receipt
    from splatpainter.receipts import verify as verify
    from splatpainter.rendering import Render as Render
    from splatpainter.rendering import render as render
    from splatpainter.scene.merge import merge as merge
    from splatpainter.scene.merge import verify_merge as verify_merge
    from splatpainter.scene.placement import Placement as Placement
    from splatpainter.server.launch import studio as studio
    from splatpainter.session import Session as Session
    from splatpainter.session.replay_operation import ReplayLayers as ReplayLayers
    from splatpainter.source_edits.edit import edit_with_source as edit_with_source
    from splatpainter.source_edits.edit import refine as refine
    from splatpainter.source_edits.fill import fill as fill
    from splatpainter.source_edits.view_edit import SourceBrief as SourceBrief
    from splatpainter.splats import Splats as Splats

# torch's threads wait for their next work by counting, 5 ms long, on the CPUs that the kernels want: a quarter of the
# CPU time of a picture with gradients. Read when OpenMP is loaded; whoever chose a way of waiting keeps it.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"} & os.environ.keys():
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"

_HOME = {
    "Splats": "splats",
    "Camera": "cameras",
    "look_at": "cameras",
    "orbit": "cameras",
    "read": "io",
    "write": "io",
    "WriteOptions": "io.write_options",
    "render": "rendering",
    "Render": "rendering",
    "edit": "editing",
    "Paint": "operations.paint",
    "LayDecal": "operations.decal",
    "Grade": "operations.grade",
    "Fill": "operations.fill",
    "Refine": "operations.refine",
    "Generate": "operations.generate",
    "Relight": "operations.light",
    "Delight": "operations.light",
    "Pixelate": "operations.pixelate",
    "pixelate": "operations.pixelate",
    "ReplayLayers": "session.replay_operation",
    "apply_to_file": "operations.to_file",
    "Painter": "painter",
    "Asset": "painter",
    "Edit": "painter",
    "Decal": "decals.decals",
    "edit_with_source": "source_edits.edit",
    "refine": "source_edits.edit",
    "SourceBrief": "source_edits.view_edit",
    "fill": "source_edits.fill",
    "adjust": "operations.grade",
    "grade": "operations.grade",
    "GradeSettings": "grading.color_grading",
    "Region": "session.operation_files",
    "ColorMatch": "grading.color_match",
    "Recolor": "grading.color_match",
    "read_cube": "grading.cube_lut",
    "light": "lights.relight",
    "delight": "lights.relight",
    "Lights": "lights.light_set",
    "Sun": "lights.lamps",
    "Lamp": "lights.lamps",
    "sky": "lights.skies",
    "read_sky": "lights.sky_maps",
    "Session": "session",
    "Receipt": "receipts",
    "merge": "scene.merge",
    "verify_merge": "scene.merge",
    "Placement": "scene.placement",
    "verify": "receipts",
    "studio": "server.launch",
}
__all__ = [
    "Asset",
    "Camera",
    "ColorMatch",
    "Decal",
    "Delight",
    "Edit",
    "Fill",
    "Generate",
    "Grade",
    "GradeSettings",
    "Lamp",
    "LayDecal",
    "Lights",
    "Paint",
    "Painter",
    "Pixelate",
    "Placement",
    "Receipt",
    "Recolor",
    "Refine",
    "Region",
    "Relight",
    "Render",
    "ReplayLayers",
    "Session",
    "SourceBrief",
    "Splats",
    "Sun",
    "WriteOptions",
    "adjust",
    "apply_to_file",
    "delight",
    "edit",
    "edit_with_source",
    "fill",
    "grade",
    "light",
    "look_at",
    "merge",
    "orbit",
    "pixelate",
    "read",
    "read_cube",
    "read_sky",
    "refine",
    "render",
    "sky",
    "studio",
    "verify",
    "verify_merge",
    "write",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f"splatpainter.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'splatpainter' has no attribute {name!r}")
