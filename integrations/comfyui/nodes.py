"""The nodes of this pack."""

from __future__ import annotations

from typing import Any

from .operation_nodes import operation_nodes
from .operations import (
    add_view,
    coverage,
    global_look,
    lift_picture,
    load_splat,
    next_view,
    render_view,
    save_splat,
    saved_files,
    splat_file_state,
)
from .schemas import Node, Slot

MAX_PX = 4096


def _splat(tooltip: str = "One gaussian splat.") -> Slot:
    return Slot("splat", "SPLAT", tooltip=tooltip)


def _camera(name: str = "camera_info", optional: bool = False) -> Slot:
    return Slot(name, "LOAD3D_CAMERA", optional, "From Next view, Create Camera Info, or a 3D viewer.")


def _pixels(name: str) -> Slot:
    return Slot(name, "INT", options={"default": 1024, "min": 64, "max": MAX_PX, "step": 8})


def _text(name: str, default: str, tooltip: str, **options: Any) -> Slot:
    return Slot(name, "STRING", tooltip=tooltip, options={"default": default, **options})


_BACKGROUND = _text("background", "#000000", "Colour behind the splat.")
_VIEWS = Slot("views", "SPLATPAINTER_VIEWS", True, "Views that are painted already; without: this is the first view.")
_RECEIPT = Slot("receipt", "STRING", tooltip="Which gaussians changed, hashes of all others, dB per view, as JSON.")

NODES = (
    Node(
        "SplatPainterLift",
        "Lift picture onto splat",
        "Put an edited picture of a splat back onto it: gaussians that the edit does not reach stay as they are.",
        (
            _splat(),
            _camera(),
            Slot("image", "IMAGE", tooltip="The edited picture of that view, of any size of the same shape."),
            Slot(
                "angle_limit",
                "FLOAT",
                tooltip="Degrees between line of sight and surface normal from which paint fades; 0: none.",
                options={"default": 80.0, "min": 0.0, "max": 90.0, "step": 1.0},
            ),
            Slot(
                "gatekeeper",
                "COMBO",
                tooltip="How a picture may differ: it is registered, its colours are corrected, and it is cut to what "
                "changed. off: used as it is.",
                options={"options": ["normal", "strict", "loose", "off"], "default": "normal"},
            ),
            Slot("mask", "MASK", True, "1 where the picture may change the splat; none: what differs."),
            Slot("before", "IMAGE", True, "The picture before it was edited, where Render Splat drew it."),
        ),
        (Slot("splat", "SPLAT"), _RECEIPT),
        lift_picture,
    ),
    Node(
        "SplatPainterNextView",
        "Next view",
        "The view that shows most of what the earlier views have not: its camera, its picture, and the mask of what is "
        "left to paint in it. Chain these to paint a splat all around.",
        (_splat(), _pixels("size"), _BACKGROUND, _VIEWS),
        (
            Slot("camera_info", "LOAD3D_CAMERA"),
            Slot("image", "IMAGE", tooltip="To be edited."),
            Slot("mask", "MASK", tooltip="1 where no earlier view has painted."),
            Slot("views", "SPLATPAINTER_VIEWS", tooltip="All views with this one, for the next."),
            Slot("left", "FLOAT", tooltip="Share of this view's surface that is left, 0..1; near 0: done."),
        ),
        next_view,
    ),
    Node(
        "SplatPainterCoverage",
        "Coverage",
        "Which part of a view other views have painted, and what is left.",
        (_splat(), Slot("views", "SPLATPAINTER_VIEWS"), _camera(), _pixels("width"), _pixels("height")),
        (
            Slot("painted", "MASK"),
            Slot("left", "MASK"),
            Slot("share", "FLOAT", tooltip="Share of the surface in this view that is painted, 0..1."),
        ),
        coverage,
    ),
    Node(
        "SplatPainterGlobalLook",
        "Global look from views",
        "Regrade or relight a whole splat from one to four edited views of it; sides that no view shows follow.",
        (
            _splat(),
            Slot("image", "IMAGE", tooltip="A regraded or relit picture of the splat."),
            _camera(),
            Slot("before", "IMAGE", True, "The picture before, where Render Splat drew it."),
            *(
                slot
                for k in (2, 3, 4)
                for slot in (
                    Slot(f"image_{k}", "IMAGE", True),
                    _camera(f"camera_info_{k}", True),
                    Slot(f"before_{k}", "IMAGE", True),
                )
            ),
        ),
        (Slot("splat", "SPLAT"), _RECEIPT),
        global_look,
    ),
    Node(
        "SplatPainterRender",
        "Render view to edit",
        "A view of a splat as 3D Gaussian Splatting draws it, which is what Lift picture compares with. Render Splat "
        "sharpens and blends in linear light: give its picture to Lift as `before`.",
        (_splat(), _camera(), _pixels("width"), _pixels("height"), _BACKGROUND),
        (Slot("image", "IMAGE"), Slot("mask", "MASK", tooltip="Alpha of the splat.")),
        render_view,
    ),
    Node(
        "SplatPainterAddView",
        "Add view",
        "A list of views with one more, for Next view and Coverage.",
        (_camera(), _pixels("width"), _pixels("height"), _VIEWS),
        (Slot("views", "SPLATPAINTER_VIEWS"),),
        add_view,
    ),
    Node(
        "SplatPainterLoad",
        "Load splat (SplatPainter)",
        "A splat file of the input folder: PLY, compressed PLY, SPLAT, SPZ, SOG, KSPLAT or GLB, with all SH bands.",
        (_text("file", "vase.ply", "Name in the input folder."),),
        (Slot("splat", "SPLAT"),),
        load_splat,
        state=splat_file_state,
    ),
    Node(
        "SplatPainterSave",
        "Save splat (SplatPainter)",
        "Write a splat and its receipt to the output folder; the name says the format.",
        (
            _splat(),
            _text("file", "painted.ply", "Name in the output folder: .ply, .compressed.ply, .splat, .spz, .sog, .glb."),
            Slot("receipt", "STRING", True, "Of Lift picture or Global look.", {"default": "", "force_input": True}),
        ),
        (Slot("path", "STRING"),),
        save_splat,
        is_output=True,
        history_entry=saved_files,
    ),
    *operation_nodes(),
)
