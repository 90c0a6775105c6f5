"""Which way up and where the front is: planted, measured, said, kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import UPS, look_at, orbit
from splatpainter.session import Session
from splatpainter.session.measures.orientation import Orientation, azimuth_of, habitual_front, measure, parsed_direction
from splatpainter.splats import Splats
from tests.support.studio_scenes import ball


def statue(turn: np.ndarray | None = None) -> Splats:
    """A ball, -y up: noise above and around, most of it towards +x, and a smooth underside. turn: [3, 3] rotation of
    all of it."""
    splats = ball(6000)
    x, y, _ = splats.means.T
    amount = np.where(x > 0.6, 1.0, 0.5) * (y < 0.5)
    sh = splats.sh * np.array([1, 0, 0, 0], np.float32)[:, None] * amount[:, None, None].astype(np.float32)
    means = splats.means if turn is None else (splats.means @ turn.T).astype(np.float32)
    return replace(splats, means=means, sh=sh)


def test_the_smooth_side_is_below_and_the_detailed_side_in_front() -> None:
    standing = measure(statue())
    assert standing.up == "-y"
    eye = orbit((0, 0, 0), 1, 1, elevation=0, start=standing.front, up=UPS["-y"])[0].position
    assert eye[0] > 0.9


@pytest.mark.parametrize("up", ["+z", "-x", "+y"])
def test_an_asset_that_stands_otherwise_is_stood_up(up: str) -> None:
    axis = np.array(UPS[up], float)
    side = np.roll(axis, 1)
    turn = np.stack([side, -axis, np.cross(side, -axis)], 1)  # -y to `up`
    turn[:, 2] *= np.sign(np.linalg.det(turn))
    assert measure(statue(turn)).up == up


def test_what_is_alike_on_all_sides_is_left_to_habit() -> None:
    even = ball(6000)
    assert measure(even) == Orientation("-y", 0.0)
    assert measure(even, "+y").front == habitual_front("+y") == 180.0


def test_nothing_to_measure_is_no_error() -> None:
    one = ball(600).take(np.zeros(1, np.int64))
    assert measure(one).up in UPS
    broken = replace(ball(600), sh=np.full((600, 4, 3), np.nan, np.float32))
    assert measure(broken).up in UPS


def test_azimuths_are_those_of_orbit() -> None:
    for up in UPS:
        for start in (0.0, 30.0, 200.0):
            view = orbit((1, 2, 3), 4, 1, elevation=20, start=start, up=UPS[up])[0]
            assert azimuth_of(view.forward, up) == pytest.approx(start, abs=1e-6)
    assert azimuth_of(np.array([0.0, 1.0, 0.0]), "-y") == 0
    for text in ("", "[1, 2]", "{}", "[1, 2, Infinity]", "x"):
        assert not parsed_direction(text).any()


def test_what_was_said_is_kept(tmp_path: Path) -> None:
    with Session(ball(), tmp_path / "a.splatproj") as session:
        assert not session.scene.is_oriented and session.scene.up == "-y"
        session.scene.set_front(look_at((3, 0, 0), (0, 0, 0), (0, -1, 0)))
        session.scene.set_up("+y")
        front = session.scene.front
    with Session.load(tmp_path / "a.splatproj") as session:
        assert session.scene.is_oriented and session.scene.up == "+y" and session.scene.front == front
        eye = orbit((0, 0, 0), 1, 1, elevation=0, start=front, up=UPS["+y"])[0].position
        assert eye[0] == pytest.approx(1)
        assert len(session.history) == 1
