"""The protocol is defined once: TypeScript is generated from it, every command is carried out and described."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from splatpainter.grading.color_grading import GradeSettings
from splatpainter.server import schema
from splatpainter.server.commands import COMMANDS
from splatpainter.server.commands.color_grading import GradePreview, GradeSliders
from splatpainter.server.commands.painting import PaintDab
from splatpainter.server.message import Message
from splatpainter.server.protocol import Answer, Command
from splatpainter.server.schema import EVENTS

WEB = Path(__file__).resolve().parents[2] / "web" / "src" / "messages.ts"


def test_the_committed_typescript_is_what_the_messages_say() -> None:
    if not WEB.exists():
        pytest.skip("no front end beside the package")
    assert WEB.read_text(encoding="utf-8") == schema.typescript(), "run python -m splatpainter.server.schema FILE"


def test_every_command_is_executed_by_something() -> None:
    named = {kind.__name__ for kind in _below(Command) if hasattr(kind, "NAME")}  # those without only share fields
    assert {kind.__name__ for kind in COMMANDS.values()} == named


def _below(kind: type) -> set[type]:
    return {one for below in kind.__subclasses__() for one in (below, *_below(below))}


def test_what_the_generator_makes_of_each_kind_of_field() -> None:
    text = schema.typescript()
    for line in (
        "export interface PaintDab {",
        "  rgba: string;",
        '  kind?: "paint" | "clone" | "erase" | "mask";',  # has a default: a client may leave it out
        "  curve?: ([number, number])[];",
        "  hues?: HueSliders[];",
        "  world_to_camera: number[][];",
        "  parameters: Record<string, unknown>;",
        "  next_view: CameraInfo | null;",
        "export interface LayerMade extends Answer {",
        '  event: "state";',  # a default of what is received is always there
        '  "paint.dab": [PaintDab, Previewed];',
        "export type Event = StateEvent | ToastEvent | PictureEvent | BatchEvent;",
        f'export const SCHEMA_HASH = "{schema.schema_hash()}";',
    ):
        assert line in text, line


def test_the_hash_changes_with_a_command_and_with_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    before = schema.schema_hash()
    monkeypatch.setitem(schema.FRAME, "FRAME_FORMAT", 2)
    changed = schema.schema_hash()
    monkeypatch.undo()
    monkeypatch.setitem(COMMANDS, "again", COMMANDS["undo"])
    assert len({before, changed, schema.schema_hash()}) == 3


def test_fields_are_described_and_strict() -> None:
    def described(kind: type[Message]) -> list[str]:
        return [name for name, field in kind.model_json_schema()["properties"].items() if field.get("description")]

    assert described(GradeSliders) == [entry.name for entry in fields(GradeSettings) if entry.name != "space"]
    assert "look" not in described(GradePreview) and "look" in GradePreview.model_fields
    assert "rgba" in described(PaintDab)
    for kind in (*COMMANDS.values(), *EVENTS, Answer):
        assert kind.model_config.get("extra") == "forbid"
