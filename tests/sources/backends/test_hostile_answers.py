"""Answers of services that can hold anything: every one is a picture or one line, never another exception."""

from __future__ import annotations

import contextlib
import json
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from splatpainter.sources.backends.comfyui import ComfyJob, find_slots
from splatpainter.sources.backends.gemini import picture_of
from splatpainter.sources.backends.http import Service, at, node_errors
from splatpainter.sources.picture_source import SourceError
from splatpainter.sources.registry import without_secrets

WORDS = (
    "candidates",
    "content",
    "parts",
    "inlineData",
    "data",
    "promptFeedback",
    "blockReason",
    "finishReason",
)
MESSAGES = (
    "type",
    "data",
    "prompt_id",
    "node",
    "value",
    "max",
    "status",
    "exec_info",
    "node_errors",
    "errors",
)
TITLES = ("splatpainter:image", "splatpainter:out", "splatpainter:prompt", "splatpainter:x", "A")
LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)


def documents(keys: tuple[str, ...], *leaves: str) -> st.SearchStrategy[Any]:
    """JSON of some likely keys."""
    return st.recursive(
        LEAVES | st.sampled_from(leaves or ("a",)),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(keys), inner, max_size=4),
        max_leaves=12,
    )


@settings(max_examples=60, deadline=None)
@given(documents(WORDS))
def test_gemini(data: Any) -> None:
    with contextlib.suppress(SourceError):
        assert isinstance(picture_of(data), bytes)


@settings(max_examples=60, deadline=None)
@given(documents(MESSAGES, "progress", "executing", "execution_error", "execution_success", "status"))
def test_comfyui_messages(data: Any) -> None:
    def progress(share: float, words: str) -> None:
        assert 0 <= share <= 1 and isinstance(words, str)

    job = ComfyJob(Service("comfyui", "http://127.0.0.1:1", {}, progress), {}, progress)
    with contextlib.suppress(SourceError):
        assert job.is_end(json.dumps(data), {}) in (True, False)
    assert isinstance(node_errors(data), str)


@settings(max_examples=40, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from("123"),
        st.fixed_dictionaries(
            {
                "class_type": st.text(max_size=5),
                "inputs": st.dictionaries(st.sampled_from(("image", "text", "seed")), LEAVES),
                "_meta": st.none() | st.fixed_dictionaries({"title": st.sampled_from(TITLES) | LEAVES}),
            }
        ),
        max_size=3,
    )
)
def test_comfyui_workflows(workflow: dict[str, Any]) -> None:
    with contextlib.suppress(SourceError):
        assert {"image", "out"} <= {*find_slots(workflow, "w.json")}


@settings(max_examples=40, deadline=None)
@given(st.text(max_size=2000))
def test_lines_are_lines(text: str) -> None:
    line = without_secrets(text)
    assert len(line) <= 600 and line.isprintable()


def test_paths_into_json() -> None:
    data = {"a": [{"b": 1}]}
    assert (at(data, "a", 0, "b"), at(data, "a", -1, "b"), at(data, "a", 1), at(data, "b", 0), at(None, 0)) == (
        1,
        1,
        None,
        None,
        None,
    )
