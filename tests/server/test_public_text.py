"""No message names a folder of this machine, or a name that only the studio knows."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from splatpainter.server.commands import files as file_commands
from splatpainter.server.public_text import public_text
from splatpainter.session.project import scratch
from tests.support.studio_scenes import Live, live_with_folder

TEMPORARY = tempfile.gettempdir()
SHA = "0123456789abcdef" * 4


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live_with_folder(tmp_path) as one:
        yield one


@pytest.mark.parametrize(
    "text, seen",
    [
        (f"{TEMPORARY}/splatpainter-verify-ab_d3f9h/asset.ply: is truncated", "asset.ply: is truncated"),
        (f"[Errno 28] No space left on device: '{TEMPORARY}/x/y/a.sog'", "[Errno 28] No space left on device: 'a.sog'"),
        ("/home/ann/work/vase.ply: is truncated", "vase.ply: is truncated"),
        ("/home/ann/work/0123456789abcdef/vase.ply: no", "vase.ply: no"),
        ("no such folder: /home/ann/work; make it first", "no such folder: the studio's folder; make it first"),
        ("/home/ann/workshop is another", "/home/ann/workshop is another"),
        ("/home/ann/work/.vase.ply.1a2b3c4d.part: full", "vase.ply: full"),
        ("/home/ann/work/.4711.part.vase.sog: full", "vase.sog: full"),
        (f"{SHA}.png: is damaged", "leather.png: is damaged"),
        (f"{SHA[::-1]}.tar.gz: is damaged", "the upload: is damaged"),
        ("0123456789abcdef.part: is damaged", "the upload: is damaged"),
        ("layer 1/2: expected 3 of 4 at /api/blobs", "layer 1/2: expected 3 of 4 at /api/blobs"),
    ],
)
def test_folders_and_names_of_ours_are_left_out(text: str, seen: str) -> None:
    names = {SHA: "leather.png"}
    assert public_text(text, [Path("/home/ann/work")], lambda sha: names.get(sha, "")) == seen


def test_the_root_is_no_folder_of_ours() -> None:
    assert public_text("a/b and /etc", [Path("/")], str) == "a/b and /etc"


def test_what_fails_in_a_scratch_folder_is_said_without_it(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also faults, whose text is the system's."""

    def broken(kind: type[Exception]) -> None:
        def export(path: Path, **_: object) -> None:
            raise kind(f"{path}: cannot be written (No space left on device)")

        monkeypatch.setattr(studio.studio.session.files, "export", export)

    for kind, status in ((ValueError, 400), (OSError, 500)):
        broken(kind)
        for name, fields in (("verify", {}), ("export", {"file": "out.ply"})):
            answer = studio.http.post(f"/api/do/{name}", json=fields)
            text = answer.json()["error"]["message"]
            assert answer.status_code == status
            assert text.endswith(("asset.ply: cannot be written (No space left on device)",
                                  "out.ply: cannot be written (No space left on device)"))  # fmt: skip
            assert "/" not in text.replace("/api/do", "") and "splatpainter-" not in text


def test_a_broken_upload_has_the_name_that_its_owner_gave(studio: Live) -> None:
    blob = studio.send(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n", "vase.ply")
    answer = studio.http.post("/api/do/asset.open", json={"blob": blob})
    assert answer.status_code == 400
    assert "vase.ply" in answer.text and blob not in answer.text and TEMPORARY not in answer.text


def test_scratch_folders_lie_where_messages_are_cleaned() -> None:
    with scratch.scratch_folder("verify") as folder:
        assert public_text(f"{folder / 'a.ply'}: no", [], str) == "a.ply: no"
    assert file_commands.scratch_folder is scratch.scratch_folder
