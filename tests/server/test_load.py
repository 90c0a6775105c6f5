"""Many clients at once, on one session and on many: ordered answers, equal Gaussians, bounded memory.

In full, as a bench: SPLATPAINTER_LOAD=20x200 python -m pytest tests/server/test_load.py -s
"""

from __future__ import annotations

import os
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from splatpainter.splats import rows_sha256
from tests.support.studio_scenes import Browser, Live, Mirror, ball, live, make_studio, view, wire

CLIENTS, EDITS = (int(number) for number in os.environ.get("SPLATPAINTER_LOAD", "12x10").split("x"))
MOST = 500 << 20
"""Bytes of resident memory that a load test may add: the session's cache of levels may grow to half of this."""


def resident() -> int:
    """Bytes of this process that are in memory now, or 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return 0 if sys.platform == "win32" else pages * os.sysconf("SC_PAGE_SIZE")


def work(browser: Browser, k: int, edits: int) -> None:
    """Edits of one client: a look layer of its own is made, hidden, faded, previewed over, and deleted."""
    layer, versions = "", []
    for n in range(edits):
        settings = {"exposure": 0.01 * (k + 1), "tint": 0.001 * n}
        if n % 5 == 0:
            answer = browser.do("look.commit", look=settings, name=f"look {k}")
            layer = answer["layer"]["id"]
        elif n % 5 == 1:
            answer = browser.do("layer.set", layer=layer, visible=False)  # else every edit below is replayed through it
        elif n % 5 == 2:
            answer = browser.do("layer.set", layer=layer, opacity=0.5)
        elif n % 5 == 3:
            browser.do("look.preview", look=settings)
            browser.do("look.preview", look=None)
            answer = browser.do("bookmark.add", name=f"{k}", camera=wire(view(48)))
        else:
            answer, layer = browser.do("layer.delete", layer=layer), ""
        versions.append(answer["version"])
        assert browser.mirror.version >= answer["version"]  # Gaussians come before the answer that speaks of them
    assert versions == sorted(versions)
    if layer:
        browser.do("layer.delete", layer=layer)


def run(served: list[Live], edits: int) -> list[Mirror]:
    """All clients at once, shared out over the studios. Fails where one fails."""
    mirrors, faults = [Mirror() for _ in range(CLIENTS)], []

    def client(k: int) -> None:
        try:
            with served[k % len(served)].greeted(mirrors[k]) as browser:
                work(browser, k, edits)
        except BaseException as error:
            faults.append(error)

    threads = [threading.Thread(target=client, args=(k,)) for k in range(CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert faults == []
    return mirrors


@pytest.mark.parametrize(("sessions", "edits"), [(1, EDITS), (4, EDITS // 2)])
def test_many_clients_end_up_with_the_same_gaussians(tmp_path: Path, sessions: int, edits: int) -> None:
    with ExitStack() as stack:
        served = []
        for k in range(sessions):
            (tmp_path / str(k)).mkdir()
            served.append(stack.enter_context(live(make_studio(tmp_path / str(k), ball(100, seed=k)))))
        with served[0].greeted() as browser:
            browser.stroke(view(48), (20, 20), 8, (250, 0, 0, 255))  # below all looks
        before = resident()
        mirrors = run(served, edits)
        assert resident() - before < MOST
        for k, mirror in enumerate(mirrors):
            studio = served[k % sessions].studio
            with served[k % sessions].greeted(mirror):  # what came while it was away
                assert mirror.agrees(studio.session.splats)
        for k, live_studio in enumerate(served):
            session = live_studio.studio.session
            assert len(session.layers) == (k == 0) and live_studio.studio.blobs.size == 0
            for layer in session.layers:  # the start of so long a history is not kept
                session.layers.delete(layer.id)
            assert rows_sha256(session.splats) == rows_sha256(session.original)


def test_strokes_of_several_clients_are_all_there(tmp_path: Path) -> None:
    with live(make_studio(tmp_path, ball(300))) as served:
        faults = []

        def paint(k: int) -> None:
            try:
                with served.greeted() as browser:
                    browser.stroke(view(48, 120.0 * k), (20, 20), 8, (0, 250, 0, 255), name=f"stroke {k}")
            except BaseException as error:
                faults.append(error)

        threads = [threading.Thread(target=paint, args=(k,)) for k in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert faults == []
        session = served.studio.session
        assert sorted(layer.name for layer in session.layers) == ["stroke 0", "stroke 1", "stroke 2"]
        assert [step.label for step in session.history][1:] == [f"add {layer.name}" for layer in session.layers]
        for k in range(3):
            seen = served.http.post("/api/do/pick", json={"camera": wire(view(48, 120.0 * k)), "x": 24, "y": 24}).json()
            assert np.argmax(seen["color"]) == 1
