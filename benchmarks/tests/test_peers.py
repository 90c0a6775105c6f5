"""`bench peers`: every program has its lines, one that is not there says so, and nothing asserts a speed."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest
from splatbench import peers

from splatpainter import demo_asset
from tests.support.cli_scenes import ball

FAKE = """import sys
if "--version" in sys.argv:
    print("splat-transform v9.8.7 (abc)", file=sys.stderr)
elif sys.argv[-1].endswith(".spz"):
    sys.exit("no spz today")
else:
    open(sys.argv[-1], "w").close()
"""


def test_every_program_has_its_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_asset, "demo_asset", ball)
    monkeypatch.setattr(peers, "TASKS", {"read PLY": {peers.OURS: peers.read_ours, "no_such_peer": peers.read_ours}})
    monkeypatch.setattr(peers, "CONVERSIONS", (("scene.ply", "out.splat"), ("scene.ply", "out.spz")))
    (tmp_path / "fake.py").write_text(FAKE)
    command = f'"{sys.executable}" "{tmp_path / "fake.py"}"'.replace("\\", "/")
    messages: list[str] = []
    config = peers.PeersBench(tmp_path / "out", quick=True, splat_transform=command)
    lines = peers.run(config, messages.append)
    assert [(line.program, line.note) for line in lines] == [
        (peers.OURS, ""), ("no_such_peer", "not installed"), (peers.OURS, ""), (peers.TRANSFORM, ""),
        (peers.OURS, ""), (peers.TRANSFORM, "failed: no spz today"),
    ]  # fmt: skip
    assert lines[3].version == lines[5].version == "9.8.7" and len(messages) == len(lines)
    assert all((line.milliseconds is None) == bool(line.note) for line in lines)
    heading, *table = (tmp_path / "out" / "peers.csv").read_text().splitlines()
    assert "cores" in heading and [row["program"] for row in csv.DictReader(table)] == [line.program for line in lines]


def test_writers_of_both_programs_make_the_same_file(tmp_path: Path) -> None:
    pytest.importorskip("gsply")
    from splatpainter.io import read, write

    write(tmp_path / "scene.ply", ball())
    peers.write_ours(str(tmp_path), 64)()
    peers.write_gsply(str(tmp_path), 64)()
    ours, other = read(tmp_path / "ours.ply"), read(tmp_path / "gsply.ply")
    assert len(ours) == len(other) and abs(ours.means - other.means).max() == 0
    assert abs(ours.sh - other.sh).max() == 0


@pytest.mark.parametrize("wrong", [{"rows": 10}, {"repeats": 0}, {"size": 4}])
def test_numbers_that_make_no_sense(wrong: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bench peers: expected --rows"):
        peers.run(peers.PeersBench(tmp_path, **wrong))  # pyright: ignore[reportArgumentType]
