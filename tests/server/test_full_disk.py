"""A project whose disk is full: what is said, where it can go on, and that nothing changes before."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from splatbench.studio_client import wire

from splatpainter.server.commands import files
from splatpainter.session import Session
from tests.support import studio_scenes
from tests.support.studio_scenes import dab, view

RED = (220, 30, 30, 255)


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "home").mkdir()
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    with studio_scenes.live_with_folder(tmp_path) as live:
        yield live


def test_a_full_disk_is_said_and_the_project_goes_on_elsewhere(live: studio_scenes.Live) -> None:
    with live.greeted() as browser:
        browser.stroke(view(), (40, 40), 16, RED, into_new="Paint")
        layer, before = browser.state["layers"][0]["id"], live.studio.session.path
        studio_scenes.fill_disk(live.studio.session)
        started = browser.do("paint.begin", camera=wire(view()))
        browser.do("paint.dab", stroke=started["stroke"], rgba=dab(16, RED), x=20, y=50, width=16, height=16)
        refused = browser.ask("paint.end", stroke=started["stroke"], layer=layer)
        assert refused["error"]["kind"] == "storage" and "disk is full" in refused["error"]["message"]
        assert refused["error"]["hint"] == "nothing was changed"
        assert live.studio.session.layers[0].strokes[0] is live.studio.session.layers[0].strokes[-1]
        keys = [folder["key"] for folder in browser.do("project.folders")["folders"]]
        assert keys[:3] == ["studio", "projects", "home"]
        moved = browser.do("project.move", folder="projects")
        assert moved["folder"] == "the studio's own folder" and before is not None and moved["file"] == before.name
        assert live.studio.session.path == live.studio.projects.root / before.name
        assert before.exists(), "it is the user's own"
        browser.do("paint.end", stroke=started["stroke"], layer=layer)
        assert len(live.studio.session.layers[0].strokes) == 2
        browser.do("project.move", folder="home")
        assert not (live.studio.projects.root / before.name).exists(), "that was the studio's own: it moved"
        after = live.studio.session.path
    assert after is not None
    with Session.load(after, readonly=True) as session:
        assert len(session.layers[0].strokes) == 2


def test_folders_without_room_or_rights_are_not_offered(
    live: studio_scenes.Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage

    def nearly_full(path: Path):
        free = files.MIN_FREE_BYTES // 2 if "home" in str(path) else usage(path).free
        return type("Usage", (), {"free": free})

    monkeypatch.setattr("splatpainter.server.commands.files.shutil.disk_usage", nearly_full)
    keys = [folder["key"] for folder in live.post("project.folders")["folders"]]
    assert "home" not in keys and "studio" in keys
    answer = live.http.post("/api/do/project.move", json={"folder": "home"})
    assert "no room" in answer.json()["error"]["message"]
    assert live.http.post("/api/do/project.move", json={"folder": "/etc"}).status_code >= 400
