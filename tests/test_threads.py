"""What several threads make at once is what each makes alone, bit for bit: of one asset that all of them use first, of
sessions of their own, and of files. Where a GIL lets one run at a time they take turns a thousand times as often."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.io import read, write
from splatpainter.kernels import library
from splatpainter.kernels.arrays import aligned
from splatpainter.painter import Edit, Painter
from splatpainter.rendering import render
from splatpainter.session import Session
from splatpainter.splats import Splats, rows_sha256
from tests.support.cli_scenes import ball
from tests.support.threads import at_once

THREADS = 4


def dab(number: int) -> Edit:
    camera = sp.look_at((0, 0, -3.5), (0, 0, 0), width=48, height=48, fov=40)
    rows, columns = np.mgrid[:48, :48]
    mask = np.hypot(columns - 18 - 3 * number, rows - 24) < 6
    return Edit(np.full((48, 48, 3), (0.2 * number, 0.8, 0.3), np.float32), camera, mask)


def asset() -> Splats:
    """New every time, so that nothing of it was made before."""
    return ball(400)


def test_views_of_one_asset() -> None:
    cameras = sp.orbit((0.0, 0.0, 0.0), 3.5, THREADS, width=40, height=40)
    expected = [render(asset(), camera).colors.tobytes() for camera in cameras]
    for _ in range(5):
        shared = asset()
        assert at_once(lambda k, shared=shared: render(shared, cameras[k]).colors.tobytes(), THREADS) == expected


def test_edits_of_one_asset() -> None:
    """Its surface, its voxels and what is known of its Gaussians are made by whoever asks first."""
    painter = Painter.load("lift")
    expected = [rows_sha256(painter.apply(painter.encode(asset()), [dab(k)]).splats) for k in range(THREADS)]
    assert len(set(expected)) == THREADS
    for _ in range(2):
        shared = painter.encode(asset())
        made = at_once(lambda k, shared=shared: rows_sha256(painter.apply(shared, [dab(k)]).splats), THREADS)
        assert made == expected


def test_sessions_with_undo(tmp_path: Path) -> None:
    def work(folder: Path, number: int) -> bytes:
        path = folder / f"{number}.ply"
        with Session(asset()) as session:
            session.layers.add("paint", [dab(number)], name="First")
            session.layers.add("look", look="grade", settings={"exposure": 0.1 * number}, name="Look")
            session.layers.add("paint", [dab(number + 1)], name="Second")
            session.undo()
            session.undo()
            session.redo()
            session.files.save_as(folder / f"{number}.splatproj")
            session.files.export(path)
        with Session.load(folder / f"{number}.splatproj") as session:
            session.verify()
        return path.read_bytes()

    for name in ("alone", "at_once"):
        (tmp_path / name).mkdir()
    expected = [work(tmp_path / "alone", k) for k in range(THREADS)]
    assert at_once(lambda k: work(tmp_path / "at_once", k), THREADS) == expected


@pytest.mark.parametrize("ending", ["ply", "spz", "sog", "splat", "compressed.ply", "glb"])
def test_files(ending: str, tmp_path: Path) -> None:
    def work(name: str, number: int) -> tuple[bytes, str]:
        path = tmp_path / f"{name}{number}.{ending}"
        write(path, ball(300 + number, degree=number % 3))
        return path.read_bytes(), rows_sha256(read(path))

    expected = [work("alone", k) for k in range(THREADS)]
    assert at_once(lambda k: work("at_once", k), THREADS) == expected


def test_kernels_that_are_asked_for_first_by_all_at_once() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(50, 3, 3)), rng.normal(size=(50, 3, 3))
    expected = [first[k] @ second[k] for k in range(50)]
    for _ in range(20):
        fresh = library.Kernels(library._path())

        def product(number: int, fresh: library.Kernels = fresh) -> np.ndarray:
            out = np.empty((50, 3, 3))
            fresh.multiply_matrices(first, second, out, 0, 1)
            return out

        for out in at_once(product, THREADS):
            np.testing.assert_allclose(out, expected, atol=1e-12)


def test_memory_that_is_used_again_has_one_owner() -> None:
    def fill(number: int) -> None:
        for k in range(300):
            arrays = [aligned((30_000,), np.dtype(np.float32)) for _ in range(3)]
            for at, array in enumerate(arrays):
                array.fill(1000 * number + k + at)
            for at, array in enumerate(arrays):
                assert array.min() == array.max() == 1000 * number + k + at

    at_once(fill, THREADS)
