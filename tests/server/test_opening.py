"""What is said while a large asset opens."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest

from splatpainter.io import files, write
from splatpainter.server.commands.context import CommandContext
from splatpainter.server.commands.files import READ_SHARE, AssetOpen, open_asset
from splatpainter.server.page_state import PageState
from splatpainter.server.work_queue import Cancelled, Ticket
from tests.support import studio_scenes


def test_how_much_of_an_asset_is_read_is_said_while_it_opens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "SHARED_BYTES", 1 << 12)
    folder = tmp_path / "shared"
    folder.mkdir()
    write(folder / "large.ply", studio_scenes.ball(700, 1))
    studio = studio_scenes.make_studio(tmp_path, shared=folder)
    heard: list[tuple[float, str]] = []
    ticket = Ticket(lambda share, stage: heard.append((share, stage)))
    open_asset(CommandContext(studio, cast(PageState, None), ticket), AssetOpen(file="large.ply"))
    shares = sorted(share for share, stage in heard if stage == "reading")
    assert (
        len(set(shares)) > 10 and shares[0] == 0 and shares[-1] == pytest.approx(READ_SHARE, rel=0.02)
    )  # a header apart
    assert np.diff(shares).max() < 0.2 * READ_SHARE
    session = studio.session
    # Cancelled amid the file: what was open stays.
    cancelled = Ticket(lambda share, stage: cancelled.cancel() if share > READ_SHARE / 3 else None)
    with pytest.raises(Cancelled):
        open_asset(CommandContext(studio, cast(PageState, None), cancelled), AssetOpen(file="large.ply"))
    assert studio.session is session
    studio.close()
