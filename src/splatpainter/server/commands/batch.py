"""Batches: the visible layers on other assets, or variants of this one. Planned first, which makes nothing but says
what would be made; then at work in a program of its own, which the pages follow by events. One at a time.

A page names assets by what it sent, by recent projects, and by files of the studio's folder: no other file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from splatpainter.batch.plan import JobList
from splatpainter.io import format_of_name
from splatpainter.server.batches.batch_folder import LOOKS, BatchFolder
from splatpainter.server.batches.batch_runs import StudioBatch
from splatpainter.server.batches.describe_batch import batch_info
from splatpainter.server.commands.color_grading import ColorTransfer, GradeSliders, settings_of
from splatpainter.server.commands.context import CommandContext, command, naming_errors
from splatpainter.server.protocol import Answer, BatchInfo, Blob, CameraInfo, Command, FileName, Message
from splatpainter.server.studio import Studio
from splatpainter.server.uploads.storage import PROJECT
from splatpainter.session import Session
from splatpainter.session.commands.session_selections import keep_selection
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, SceneAsset
from splatpainter.session.project.asset_files import write_original

MAX_ASSETS, MAX_VARIANTS = 500, 200
MAX_LISTED_LAYERS = 5
"""Most layers whose names a title lists."""


class BatchAsset(Message):
    """Exactly one of: a blob that was sent, an id of `project.recent` (the asset of that project), a file of the
    studio's folder."""

    blob: Blob | None = None
    name: str = Field(default="", max_length=300)
    """What its owner calls the blob; never a path."""
    recent: str | None = Field(default=None, max_length=300)
    file: FileName | None = None


class BatchVariant(Message):
    """The present asset with one change more; without sliders and colours from elsewhere: as it is."""

    name: str = Field(min_length=1, max_length=100)
    """Part of the file's name."""
    look: GradeSliders | None = None
    transfer: ColorTransfer | None = None
    on: Literal["everything", "selected", "selection", "layer"] = "everything"
    """What changes; selected: what is selected now."""
    of: str = Field(default="", max_length=200)
    """Name of a selection that the project keeps, or id of a layer."""


class BatchAnswer(Answer):
    batch: BatchInfo | None
    """None: there is none."""
    revision: int
    """Revision, as in BatchEvent."""


class BatchPlan(Command):
    """Say what a batch would make; nothing is made yet. Results of the batch before are removed. Either assets, on
    which the visible layers are painted anew, or variants of the present asset."""

    NAME = "batch.plan"
    ANSWER = BatchAnswer
    assets: list[BatchAsset] = Field(default=[], max_length=MAX_ASSETS)
    variants: list[BatchVariant] = Field(default=[], max_length=MAX_VARIANTS)
    asset: str | None = Field(default=None, max_length=100)
    """Id of the asset, of several in the session, whose layers or variants are meant."""
    format: Literal["", "ply", "compressed.ply", "splat", "spz", "sog", "glb"] = ""
    """Format of the results; "": that of each asset."""
    camera: CameraInfo | None = None
    """Camera of the small pictures; None: from the front."""


class BatchStart(Command):
    """Make what was planned, in a program of its own; events say how it goes."""

    NAME = "batch.start"
    ANSWER = BatchAnswer
    batch: str = Field(max_length=32)


class BatchCancel(Command):
    """End the batch; results that are done stay."""

    NAME = "batch.cancel"
    ANSWER = BatchAnswer
    batch: str = Field(max_length=32)


class BatchDiscard(Command):
    """Remove a batch that is not at work, with its results."""

    NAME = "batch.discard"
    batch: str = Field(max_length=32)


class BatchStatus(Command):
    """The studio's batch."""

    NAME = "batch.status"
    ANSWER = BatchAnswer


@command(BatchPlan, background=True, once=True)
def plan_batch(context: CommandContext, request: BatchPlan) -> BatchAnswer:
    # Two kinds of batches by one command; with both it is open which layers are meant.
    if bool(request.assets) == bool(request.variants):
        raise ValueError("batch: expected assets or variants; choose at least one asset, or fill in one row")
    studio = context.studio
    camera = None if request.camera is None else request.camera.to_camera().to_json()

    # Fills the folder of the new batch; where it refuses, that folder goes and the batch before stays.
    def prepare(folder: Path) -> tuple[JobList, list[str], str]:
        batch = BatchFolder(folder)
        context.ticket.report(0, "copying the project")
        session = studio.session
        present, number = _present_asset(session, request.asset)
        name = present.name if number else studio.state.asset.name
        # A copy of the project: the layers may change while the batch is at work.
        session.files.save_copy(batch.project)
        visible = [layer.name for layer in session.layers if layer.visible and layer.asset == present.id]
        replay = [{"layers": {"project": batch.project.name, "asset": number}}] if visible else []
        names = f"{', '.join(visible[:MAX_LISTED_LAYERS])}{', ...' if len(visible) > MAX_LISTED_LAYERS else ''}"
        if request.assets:
            # Without a visible layer every result would be its asset.
            if not replay:
                on = f" of {name}" if number else ""
                raise ValueError(f"batch: no visible layer{on} to put onto other assets; paint something first")
            batch.edits = replay
            # Assets are linked or copied now: uploads go with the studio, and files of the folder may change.
            for number, asset in enumerate(request.assets):
                context.ticket.report(number / len(request.assets), "collecting assets")
                _add_asset(context, batch, asset)
            title = f"Layers of {name} on {_count(len(request.assets), 'asset')}"
            words = [f"layers: {names}"] * len(request.assets)
        else:
            # The present asset is written out as it was read; variants begin from there.
            added = present if present.id != MAIN_ASSET_ID else None
            format = studio.state.asset.format if added is None else format_of_name(Path(added.file))
            original = session.scene.original_of(present.id)
            asset, batch.axes = write_original(batch.project, batch.stem(name, f".{format}"), original, added)
            batch.assets.append(asset)
            batch.variants, words = _variants(context, batch, request.variants, replay)
            title = f"{_count(len(request.variants), 'variant')} of {name}"
        return batch.plan(request.format, camera), words, title

    return _answer(studio, studio.batches.make(prepare))


@command(BatchStart, background=True, once=True)
def start_batch(context: CommandContext, request: BatchStart) -> BatchAnswer:
    return _answer(context.studio, context.studio.batches.start(request.batch))


@command(BatchCancel)
def cancel_batch(context: CommandContext, request: BatchCancel) -> BatchAnswer:
    return _answer(context.studio, context.studio.batches.cancel(request.batch))


@command(BatchDiscard, background=True)
def discard_batch(context: CommandContext, request: BatchDiscard) -> Answer:
    context.studio.batches.discard(request.batch)
    return Answer()


@command(BatchStatus)
def show_batch(context: CommandContext, request: BatchStatus) -> BatchAnswer:
    revision = context.studio.batches.revision  # first: what is described may be newer, never older
    batch = context.studio.batches.present
    return BatchAnswer(batch=None if batch is None else batch_info(context.studio, batch), revision=revision)


def _answer(studio: Studio, batch: StudioBatch) -> BatchAnswer:
    revision = studio.batches.revision
    return BatchAnswer(batch=batch_info(studio, batch), revision=revision)


def _present_asset(session: Session, asset: str | None) -> tuple[SceneAsset, str]:
    """The asset whose layers or variants are meant, and its number among several, or "". Raises ValueError: none of
    several is chosen; unknown."""
    # One asset needs no name; of several none is taken by chance.
    if len(session.scene.assets) == 1:
        return session.scene.assets[0], ""
    if asset is None:
        names = ", ".join(one.name for one in session.scene.assets)
        raise ValueError(f"batch: several assets are open ({names}); choose the one that is meant")
    present = session.scene.asset(asset)
    return present, str(1 + session.scene.assets.index(present))


def _add_asset(context: CommandContext, batch: BatchFolder, asset: BatchAsset) -> None:
    studio = context.studio
    # Each says where its bytes come from, so exactly one.
    if sum(source is not None for source in (asset.blob, asset.recent, asset.file)) != 1:
        raise ValueError("batch: expected one of blob, recent or file for each asset")
    if asset.blob is not None:
        blob = studio.blobs.get(asset.blob, "asset")
        batch.add_file(blob.path, asset.name or blob.name, blob.info.ending)
    elif asset.recent is not None:
        # Of a recent project its asset is meant, as it was read, without its layers.
        path = studio.projects.find(asset.recent)
        name = studio.projects.name_of(path)
        with naming_errors(path, name):
            batch.assets.append(write_original(path, batch.stem(name))[0])
    else:
        name = asset.file or ""
        if studio.folder is None:
            raise ValueError(f"{name}: the studio was started without a folder; drop the file into the page instead")
        # A project is no asset; its layers would silently be left out.
        if name.lower().endswith(PROJECT):
            raise ValueError(f"{name}: is a project; expected a splat file")
        path = studio.folder.file(name)
        ending = "".join(path.suffixes[-2:]) if name.lower().endswith(".compressed.ply") else path.suffix
        batch.add_file(path, name, ending.lower())


def _variants(
    context: CommandContext, batch: BatchFolder, variants: list[BatchVariant], replay: list[dict[str, Any]]
) -> tuple[list[dict[str, Any]], list[str]]:
    """(as a JOBS.yaml has them, what is done for each)."""
    # Variants often share a region; it is stored once in the batch's project.
    regions: dict[tuple[str, str], tuple[list[str], str]] = {}
    entries, words = [], []
    for number, variant in enumerate(variants):
        key = (variant.on, variant.of)
        if key not in regions:
            regions[key] = _region(context, batch, variant, f"region-{len(regions)}")
        where, region_words = regions[key]
        grade, look_words = _grade(context, batch, variant, number)
        edits = [*replay, *([{"grade": {**grade, "where": where}}] if grade else [])]
        # A variant like the asset without a layer either would be a copy under another name.
        if not edits:
            raise ValueError(f"batch: {variant.name}: changes nothing; give it a colour or an adjustment")
        entries.append({"name": variant.name.strip(), "edits": edits})
        words.append(f"{look_words} on {region_words}" if grade else "as it is")
    return entries, words


def _region(context: CommandContext, batch: BatchFolder, variant: BatchVariant, name: str) -> tuple[list[str], str]:
    """(terms of `where`, words) of what a variant changes. name: of a selection that the batch's project gets."""
    studio = context.studio
    if variant.on == "everything":
        return [], "everything"
    if variant.on == "layer":
        layer = studio.session.layers.by_id(variant.of)
        return [f"layer={layer.id}@{batch.project.name}"], layer.name
    # What is selected now has no name; it is kept under one in the batch's copy, not in the user's project.
    if variant.on == "selected":
        stored = studio.selection.stored()
        if stored is None:
            raise ValueError(f"batch: {variant.name}: nothing is selected; select something first, or take everything")
        keep_selection(batch.project, name, stored[1])
        return [f"selection={name}@{batch.project.name}"], "what was selected"
    keep_selection(batch.project, name, variant.of)
    return [f"selection={name}@{batch.project.name}"], variant.of


def _grade(
    context: CommandContext, batch: BatchFolder, variant: BatchVariant, number: int
) -> tuple[dict[str, Any], str]:
    """(keys of `grade`, words); without any: it stays as it is."""
    transfer = variant.transfer
    # Sliders and colours from elsewhere are two looks, and one variant has one.
    if variant.look is not None and transfer is not None:
        raise ValueError(f"batch: {variant.name}: expected either sliders or colours from elsewhere")
    if variant.look is not None:
        folder = batch.root / LOOKS / str(number)
        try:
            folder.mkdir(parents=True)
            (folder / "look.json").write_text(json.dumps(settings_of(context.studio, variant.look)), encoding="utf-8")
        except OSError as error:
            raise ValueError(f"batch: cannot be kept ({error.strerror or error})") from None
        return {"look": f"{LOOKS}/{number}/look.json"}, "adjustment"
    if transfer is None:
        # Without a look the variant is the asset as it is, perhaps with its layers.
        return {}, ""
    shared = {"strength": transfer.strength}
    if transfer.kind == "recolor":
        if transfer.color is None:
            raise ValueError(f"batch: {variant.name}: expected a colour")
        return {"recolor": transfer.color, **shared}, f"new colour {transfer.color}"
    if transfer.file is None:
        raise ValueError(f"batch: {variant.name}: expected a file: a .cube table, or a reference picture")
    # The kind of the upload is checked, for the batch reads the file much later.
    blob = context.studio.blobs.get(transfer.file, "lut" if transfer.kind == "lut" else "picture")
    file = batch.look_file(number, blob.path, blob.name, blob.info.ending)
    return {transfer.kind: file, **shared}, f"{'LUT' if transfer.kind == 'lut' else 'colours of'} {blob.name}"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
