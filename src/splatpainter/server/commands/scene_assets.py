"""Several assets in one scene: added, moved, hidden, removed, and matched in colour."""

from __future__ import annotations

import contextlib
from typing import Any

from pydantic import Field

from splatpainter.scene.placement import Placement
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    command,
    layer_made,
    naming_errors,
    progress,
    python_line,
)
from splatpainter.server.commands.files import folder_file
from splatpainter.server.protocol import Answer, Blob, Command, FileName, LayerMade, Name, Point
from splatpainter.server.uploads.storage import demo
from splatpainter.session.project.asset_files import write_original
from splatpainter.session.project.scratch import scratch_folder


class AssetAdded(Answer):
    asset: str
    """Id of the asset."""


class AssetAdd(Command):
    """One more asset in the scene, to the right of what is there. Exactly one of: a blob that was sent, a file of the
    studio's folder, the asset of a recent project (as it was read), the demo asset."""

    NAME = "scene.add"
    ANSWER = AssetAdded
    blob: Blob | None = None
    file: FileName | None = None
    recent: str | None = None
    demo: bool = False


@command(AssetAdd, writes=True)
def add_asset(context: CommandContext, request: AssetAdd) -> AssetAdded:
    studio = context.studio
    # As with `asset.open`: exactly one place.
    if sum(one is not None for one in (request.blob, request.file, request.recent)) + request.demo != 1:
        raise ValueError("asset: expected one of blob, file, recent or demo")
    with contextlib.ExitStack() as stack, progress(context, "reading"):
        if request.blob is not None:
            blob = studio.blobs.get(request.blob, "asset")
            asset, name, axes = blob.path, blob.name or f"asset{blob.info.ending}", "auto"
        elif request.file is not None:
            asset, name, axes = folder_file(studio, request.file), request.file, "auto"
        elif request.recent is not None:
            # Its asset as it was read, not as its layers left it.
            project = studio.projects.find(request.recent)
            folder = stack.enter_context(scratch_folder("added"))
            asset, axes = write_original(project, folder / "asset")
            name = studio.projects.name_of(project)
        else:
            asset, name, axes = demo(), "demo", "auto"
        # Errors name the file as its owner knows it, not the copy.
        if not request.demo:
            stack.enter_context(naming_errors(asset, name))  # type: ignore[arg-type]
        added = studio.session.scene.add(asset, name=name, axes=axes)
    return AssetAdded(asset=added.id, python=python_line("session.scene.add", name))


class AssetSet(Command):
    """Change an asset of the scene; numbers that are null stay."""

    NAME = "scene.set"
    asset: str
    name: Name | None = None
    visible: bool | None = None
    move: Point | None = None
    turn: Point | None = None
    """Degrees about x, then y, then z."""
    scale: float | None = None
    gesture: Name | None = None
    """Gesture as in layer.set."""


@command(AssetSet, writes=True)
def set_asset(context: CommandContext, request: AssetSet) -> Answer:
    session = context.studio.session
    # The page works relative to the offset, the scene in the world.
    offsets = session.scene.original_of(request.asset).offset, session.original.offset  # the page works beside them
    before = session.scene.asset(request.asset).placement.between(*offsets)
    values: dict[str, Any] = {}
    if request.move is not None or request.turn is not None or request.scale is not None:
        (x, y, z), (a, b, c) = request.move or before.move, request.turn or before.turn
        scale = before.scale if request.scale is None else request.scale
        placement = Placement.of((x, y, z), (a, b, c), scale)
        # The rotation is kept as it is stored: through angles and back it would drift.
        if request.turn is None:
            placement = Placement((x, y, z), before.quat, scale)
        values["placement"] = placement.in_world(*offsets)
    values |= {key: value for key in ("name", "visible") if (value := getattr(request, key)) is not None}
    with progress(context, "moving"):
        session.scene.set(request.asset, gesture=request.gesture, **values)
    words = {key: RawExpr(f"sp.{value!r}") if key == "placement" else value for key, value in values.items()}
    return Answer(python=python_line("session.scene.set", request.asset, **words))


class AssetRemove(Command):
    """Take an asset out of the scene, with its layers."""

    NAME = "scene.remove"
    asset: str


@command(AssetRemove, writes=True)
def remove_asset(context: CommandContext, request: AssetRemove) -> Answer:
    context.studio.session.scene.remove(request.asset)
    return Answer(python=python_line("session.scene.remove", request.asset))


class AssetMatchSeam(Command):
    """An adjustment layer that brings an asset's colours to those of the others where they are near to each other."""

    NAME = "scene.match"
    ANSWER = LayerMade
    asset: str
    falloff: float = Field(default=0.0, ge=0)
    """World units over which it fades out from the seam; 0: it holds everywhere."""


@command(AssetMatchSeam, writes=True)
def match_colors(context: CommandContext, request: AssetMatchSeam) -> LayerMade:
    with progress(context, "matching colours"):
        layer = context.studio.session.scene.match_seam(request.asset, falloff=request.falloff)
    line = python_line("session.scene.match_seam", request.asset, falloff=request.falloff)
    return layer_made(context, layer.id, line)
