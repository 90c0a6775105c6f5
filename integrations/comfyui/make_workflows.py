"""Write the example workflows, in the format that ComfyUI's page opens: python -m integrations.comfyui.make_workflows

Nodes of this pack come from its own descriptions, so widgets and links cannot differ from them. Where an artist's own
edit belongs (a sampler, an inpainting or a service node) stands Invert Image, a node of the core without settings.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .nodes import NODES
from .schemas import WIDGETS

FOLDER = Path(__file__).parent / "workflows"
CORE: dict[str, tuple[dict[str, str], dict[str, str], list[Any]]] = {
    "ImageInvert": ({"image": "IMAGE"}, {"IMAGE": "IMAGE"}, []),
    "PreviewImage": ({"images": "IMAGE"}, {}, []),
    "LoadImage": ({}, {"IMAGE": "IMAGE", "MASK": "MASK"}, ["example.png", "image"]),
}
"""Nodes of ComfyUI's core -> inputs, outputs, values of widgets."""
COLUMN_PX, ROW_PX = 380, 260


class Graph:
    """Nodes and links of a workflow (version 0.4 of the page's format)."""

    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []
        self.links: list[list[Any]] = []

    def add(self, kind: str, column: int, row: int, inputs: dict[str, tuple[int, str]] | None = None, **widgets) -> int:
        """A node; inputs: id -> (node, its output); gives its number."""
        number = len(self.nodes) + 1
        if kind in CORE:
            takes, gives, values = CORE[kind]
        else:
            node = next(node for node in NODES if node.id == kind)
            widget_slots = {
                slot.id: slot for slot in node.inputs if slot.type in WIDGETS and not slot.options.get("force_input")
            }
            takes = {slot.id: slot.type for slot in node.inputs if slot.id not in widget_slots}
            gives = {slot.id: slot.type for slot in node.outputs}
            values = [widgets.get(name, slot.options.get("default")) for name, slot in widget_slots.items()]
        entry: dict[str, Any] = {
            "id": number,
            "type": kind,
            "pos": [COLUMN_PX * column, ROW_PX * row],
            "size": [320, 200],
            "flags": {},
            "order": number - 1,
            "mode": 0,
            "inputs": [{"name": name, "type": type_name, "link": None} for name, type_name in takes.items()],
            "outputs": [{"name": name, "type": type_name, "links": []} for name, type_name in gives.items()],
            "properties": {"Node name for S&R": kind},
            "widgets_values": values,
        }
        self.nodes.append(entry)
        for name, (source, output) in (inputs or {}).items():
            slots = self.nodes[source - 1]["outputs"]
            index = next(k for k, slot in enumerate(slots) if slot["name"] == output)
            target = next(k for k, slot in enumerate(entry["inputs"]) if slot["name"] == name)
            link = len(self.links) + 1
            self.links.append([link, source, index, number, target, slots[index]["type"]])
            slots[index]["links"].append(link)
            entry["inputs"][target]["link"] = link
        return number

    def note(self, column: int, row: int, text: str) -> None:
        number = len(self.nodes) + 1
        entry = {"id": number, "type": "Note", "pos": [COLUMN_PX * column, ROW_PX * row], "size": [340, 160]}
        rest: dict[str, Any] = {"flags": {}, "order": number - 1, "mode": 0, "inputs": [], "outputs": []}
        self.nodes.append({**entry, **rest, "properties": {}, "widgets_values": [text]})

    def document(self) -> dict[str, Any]:
        return {
            "last_node_id": len(self.nodes),
            "last_link_id": len(self.links),
            "nodes": self.nodes,
            "links": self.links,
            "groups": [],
            "config": {},
            "extra": {},
            "version": 0.4,
        }


def paint_all_around(views: int = 3) -> Graph:
    """Next view, edit, lift, as many times."""
    graph = Graph()
    splat = graph.add("SplatPainterLoad", 0, 0)
    graph.note(0, 1, "Put your own edit in place of each Invert Image: it gets the picture and the mask of Next view.")
    output, seen, receipt = "splat", None, None
    for k in range(views):
        inputs = {"splat": (splat, output)} | ({"views": (seen, "views")} if seen else {})
        view = graph.add("SplatPainterNextView", 4 * k + 1, 0, inputs)
        edit = graph.add("ImageInvert", 4 * k + 2, 0, {"image": (view, "image")})
        links = {"splat": (splat, output), "camera_info": (view, "camera_info"), "image": (edit, "IMAGE")}
        splat = graph.add("SplatPainterLift", 4 * k + 3, 0, {**links, "mask": (view, "mask")}, gatekeeper="off")
        seen, receipt = view, (splat, "receipt")
    assert receipt is not None
    graph.add("SplatPainterSave", 4 * views + 1, 0, {"splat": (splat, "splat"), "receipt": receipt})
    return graph


def lift_edited_file() -> Graph:
    """A picture that was edited elsewhere, put back by the view that it was made from."""
    graph = Graph()
    splat = graph.add("SplatPainterLoad", 0, 0)
    view = graph.add("SplatPainterNextView", 1, 0, {"splat": (splat, "splat")})
    graph.add("PreviewImage", 2, 1, {"images": (view, "image")})
    picture = graph.add("LoadImage", 1, 2)
    links = {"splat": (splat, "splat"), "camera_info": (view, "camera_info"), "image": (picture, "IMAGE")}
    lift = graph.add("SplatPainterLift", 2, 0, links)
    graph.add("SplatPainterSave", 3, 0, {"splat": (lift, "splat"), "receipt": (lift, "receipt")})
    graph.note(0, 2, "1. Run, save the preview, paint on it in any program. 2. Load it in Load Image and run again.")
    return graph


def global_look() -> Graph:
    """Two regraded views change the whole splat."""
    graph = Graph()
    splat = graph.add("SplatPainterLoad", 0, 0)
    first = graph.add("SplatPainterNextView", 1, 0, {"splat": (splat, "splat")})
    second = graph.add("SplatPainterNextView", 1, 2, {"splat": (splat, "splat"), "views": (first, "views")})
    edits = [graph.add("ImageInvert", 2, 2 * k, {"image": (view, "image")}) for k, view in enumerate((first, second))]
    links = {"splat": (splat, "splat"), "image": (edits[0], "IMAGE"), "camera_info": (first, "camera_info")}
    links |= {"image_2": (edits[1], "IMAGE"), "camera_info_2": (second, "camera_info")}
    look = graph.add("SplatPainterGlobalLook", 3, 0, links)
    graph.add("SplatPainterSave", 4, 0, {"splat": (look, "splat"), "receipt": (look, "receipt")}, file="night.ply")
    graph.note(0, 1, "Put a relighting or grading of both pictures in place of Invert Image.")
    return graph


WORKFLOWS = {
    "paint_all_around.json": paint_all_around,
    "lift_edited_file.json": lift_edited_file,
    "global_look.json": global_look,
}


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, build in WORKFLOWS.items():
        (FOLDER / name).write_text(json.dumps(build().document(), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
