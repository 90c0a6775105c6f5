"""`pixelate`: nothing of the old look is left in the file, nothing else changes, and `verify` sees both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.io import read, write
from splatpainter.operations.pixelate import Pixelate
from splatpainter.receipts import Receipt
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats
from tests.support.cli_scenes import Capture, ball, run

REGION = ["sphere=0,0,-1,0.5"]
SIZE = 0.25


def checkered(count: int = 3000, degree: int = 2) -> Splats:
    """A ball whose Gaussians are black or white by chance, with noise in all bands, and a smaller one within it."""
    rng = np.random.default_rng(3)
    outer, inner = ball(count, degree=degree), ball(400, radius=0.85, degree=degree)
    splats = outer.append(inner)
    sh = rng.normal(0, 0.1, splats.sh.shape).astype(np.float32)
    sh[:, 0] = ((rng.random((len(splats), 1)) > 0.5) - 0.5) / SH_C0
    return replace(splats, sh=sh)


def region_of(splats: Splats) -> np.ndarray:
    """[N] bool: in the sphere, by hand."""
    return ((splats.means - (0, 0, -1)) ** 2).sum(1) <= 0.25


def cells_of(splats: Splats) -> np.ndarray:
    return np.floor(splats.means.astype(np.float64) / SIZE).astype(int)


@pytest.mark.parametrize("merge", [False, True])
@pytest.mark.parametrize("style", ["cells", "blur"])
def test_what_is_written_depends_on_the_means_alone(style, merge: bool) -> None:
    """Two looks with equal means in every cell become the same file; elsewhere every bit stays."""
    splats = checkered()
    first = sp.pixelate(splats, sp.Region.parse(REGION), size=SIZE, style=style, merge=merge)
    assert first.receipt is not None and first.receipt.pixelation is not None
    rows = first.receipt.pixelation.rows
    assert np.isin(np.flatnonzero(region_of(splats)), rows).all()
    rest = np.setdiff1d(np.arange(len(splats)), rows)
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(first.splats, name)[rest], getattr(splats, name)[rest])
    assert (first.splats.sh[rows, 1:] == 0).all() and first.receipt.pixelation.problems(first.splats) == []
    # The colours of a cell's Gaussians of one size and opacity in another order: the same means.
    shuffled, cells = splats.sh.copy(), cells_of(splats)
    sizes = splats.scales[:, 0]
    changing = np.isin(np.arange(len(splats)), rows)
    for cell in np.unique(cells[rows], axis=0):
        for size in np.unique(sizes):
            ids = np.flatnonzero((cells == cell).all(1) & (sizes == size) & changing)
            shuffled[ids] = splats.sh[ids[::-1]]
    second = sp.pixelate(replace(splats, sh=shuffled), sp.Region.parse(REGION), size=SIZE, style=style, merge=merge)
    for name in ATTRIBUTES:
        assert np.allclose(getattr(first.splats, name), getattr(second.splats, name), atol=2e-6)


def test_each_cell_has_the_mean_of_its_colours() -> None:
    splats = checkered()
    edited = sp.pixelate(splats, sp.Region.parse(REGION), size=SIZE)
    assert edited.receipt is not None and edited.receipt.pixelation is not None
    rows, cells = edited.receipt.pixelation.rows, cells_of(splats)
    assert edited.receipt.pixelation.cells == len(np.unique(cells[rows], axis=0))
    for cell in np.unique(cells[region_of(splats)], axis=0):
        ids = np.flatnonzero((cells == cell).all(1))
        assert np.isin(ids, rows).all(), "cells are taken whole"
        shares = splats.opacities[ids] * splats.scales[ids, 0] * splats.scales[ids, 1]
        colors = np.clip(0.5 + SH_C0 * splats.sh[ids, 0].astype(np.float64), 0, 1)
        mean = (shares[:, None] * colors).sum(0) / shares.sum()
        assert np.allclose(0.5 + SH_C0 * edited.splats.sh[ids, 0], mean, atol=1e-5)


def test_hidden_gaussians_behind_the_region_change_too() -> None:
    """The inner ball shows from nowhere; cells of the outer one's surface do not reach it."""
    splats = checkered()
    edited = sp.pixelate(splats, sp.Region.parse(["sphere=0,0,-1,0.3 sphere=0,0,-1.3,0.4"]), size=0.09)
    assert edited.receipt is not None and edited.receipt.pixelation is not None
    claim = edited.receipt.pixelation
    inside = np.linalg.norm(splats.means, axis=1) < 0.9
    assert int(inside[claim.rows].sum()) >= claim.inner > 3
    near = inside & (np.linalg.norm(splats.means - (0, 0, -1), axis=1) < 0.2)
    assert np.isin(np.flatnonzero(near), claim.rows).all() and (edited.splats.sh[claim.rows, 1:] == 0).all()


def test_merged_rows_hold_nothing_of_what_was_there() -> None:
    splats = checkered()
    edited = sp.pixelate(splats, sp.Region.parse(REGION), size=SIZE, merge=True)
    assert edited.receipt is not None and edited.receipt.pixelation is not None
    claim = edited.receipt.pixelation
    for name in ("means", "scales", "quats", "sh"):
        values = getattr(edited.splats, name)[claim.rows].reshape(len(claim.rows), -1)
        assert len(np.unique(values, axis=0)) <= claim.cells, name
    assert int((edited.splats.opacities[claim.rows] > 0).sum()) == claim.cells
    assert np.isin(edited.receipt.removed, edited.receipt.touched).all()


def test_one_color_leaves_none() -> None:
    edited = sp.pixelate(checkered(), sp.Region.parse(REGION), size=SIZE, color=(0.2, 0.4, 0.6))
    assert edited.receipt is not None and edited.receipt.pixelation is not None
    colors = 0.5 + SH_C0 * edited.splats.sh[edited.receipt.pixelation.rows, 0]
    assert np.allclose(colors, (0.2, 0.4, 0.6), atol=1e-6) and edited.receipt.pixelation.colors == 1


def test_cells_of_a_view_and_a_margin() -> None:
    splats, region = checkered(), sp.Region.parse(REGION)
    camera = sp.look_at((2, 1, -3), (0, 0, 0), (0, -1, 0), width=64, height=64)
    plain = sp.pixelate(splats, region, size=SIZE)
    turned = sp.pixelate(splats, region, size=SIZE, camera=camera)
    wide = sp.pixelate(splats, region, size=SIZE, margin=1)
    rows = [one.receipt.pixelation.rows for one in (plain, turned, wide) if one.receipt and one.receipt.pixelation]
    assert not np.array_equal(rows[0], rows[1]) and set(rows[0]) < set(rows[2])
    cells = np.floor(splats.means.astype(np.float64) @ camera.world_to_camera[:3, :3].T / SIZE)
    for cell in np.unique(cells[rows[1]], axis=0)[:20]:
        ids = np.flatnonzero((cells == cell).all(1) & np.isin(np.arange(len(splats)), rows[1]))
        assert len(np.unique(turned.splats.sh[ids, 0], axis=0)) == 1


def test_a_margin_is_of_cells_on_all_sides() -> None:
    """Of each corner's neighbours as well; compared with distances of cells, counted by hand."""
    splats, cells = checkered(), cells_of(checkered())
    edited = sp.pixelate(splats, sp.Region.parse(["sphere=0.6,0.6,-0.5,0.1"]), size=SIZE, margin=1)
    assert edited.receipt is not None and edited.receipt.pixelation is not None
    reached = np.unique(cells[((splats.means - (0.6, 0.6, -0.5)) ** 2).sum(1) <= 0.01], axis=0)
    assert len(reached) > 0
    within = (np.abs(cells[:, None] - reached[None]).max(-1) <= 1).any(1)
    outer = np.arange(len(splats)) < 3000  # the smaller ball is hidden, and changes by another rule
    changed = np.isin(np.arange(len(splats)), edited.receipt.pixelation.rows)
    assert np.array_equal(changed[outer], within[outer])


def test_what_is_selected_a_little_changes_whole() -> None:
    """Half of an old look is a look."""
    splats = checkered()
    weights = np.where(region_of(splats), 0.2, 0).astype(np.float32)
    little = Pixelate(where=("x=-9..",), size=SIZE).apply_selected(sp.Asset(splats), weights)
    expected = sp.pixelate(splats, sp.Region.parse(REGION), size=SIZE)
    assert little.receipt is not None and expected.receipt is not None
    assert np.array_equal(little.receipt.touched, expected.receipt.touched)
    assert np.array_equal(little.splats.sh, expected.splats.sh)


def test_cells_are_those_of_the_world_whatever_positions_are_relative_to() -> None:
    splats = checkered()
    splats = replace(splats, means=np.round(splats.means * 1024) / np.float32(1024))  # so that moving them is exact
    offset = (0.125, -3.0625, 1000.0)
    moved = replace(splats, means=(splats.means - np.array(offset)).astype(np.float32), offset=offset)
    everywhere = sp.Region.parse(["x=-9.."])
    near, far = (sp.pixelate(one, everywhere, size=SIZE) for one in (splats, moved))
    assert np.array_equal(near.splats.sh, far.splats.sh)


def test_verify_checks_the_claim_in_the_file(tmp_path: Path, capfd: Capture) -> None:
    asset, out = tmp_path / "a.ply", tmp_path / "b.ply"
    write(asset, checkered())
    done = run(capfd, "pixelate", asset, "--where", *REGION, "--size", SIZE, "--out", out, "--json")
    assert done.code == 0 and done.json["verified"], done.err
    assert done.json["receipt"]["pixelation"]["rows"] > 100
    receipt = Receipt.from_json((tmp_path / "b.ply.receipt.json").read_text())
    assert receipt.pixelation is not None and receipt.to_json() == (tmp_path / "b.ply.receipt.json").read_text()
    assert run(capfd, "verify", asset, out).code == 0
    # A file of which the receipt says so, in which one row is as it was.
    before, leaking = read(asset), read(out)
    sh = leaking.sh.copy()
    sh[receipt.pixelation.rows[0]] = before.sh[receipt.pixelation.rows[0]]
    write(tmp_path / "c.ply", replace(leaking, sh=sh))
    leaked = replace(receipt, output_sha256=read(tmp_path / "c.ply").sha256)
    (tmp_path / "c.ply.receipt.json").write_text(leaked.to_json())
    verified = run(capfd, "verify", asset, tmp_path / "c.ply")
    assert verified.code == 1 and "SH above degree 0 is not cleared in 1 rows" in verified.out


def test_a_later_operation_takes_the_claim_back(tmp_path: Path, capfd: Capture) -> None:
    write(tmp_path / "a.ply", checkered(900))
    words = ["pixelate", "--where", *REGION, "--size", SIZE, "grade", "--exposure", 0.2]
    done = run(capfd, "edit", tmp_path / "a.ply", *words, "--out", tmp_path / "b.ply", "--json")
    assert done.code == 0 and "pixelation" not in done.json["receipt"]
    words = ["grade", "--exposure", 0.2, "pixelate", "--where", *REGION, "--size", SIZE]
    done = run(capfd, "edit", tmp_path / "a.ply", *words, "--out", tmp_path / "c.ply", "--json")
    assert done.code == 0 and done.json["receipt"]["pixelation"]["cells"] > 1


def test_bad_gaussians_and_formats_that_round(tmp_path: Path, capfd: Capture) -> None:
    splats = checkered(900)
    means, sh = splats.means.copy(), splats.sh.copy()
    means[3], sh[5, 0, 1] = np.nan, np.nan
    write(tmp_path / "a.ply", replace(splats, means=means, sh=sh))
    for name in ("b.ply", "b.spz", "b.compressed.ply"):
        done = run(capfd, "pixelate", tmp_path / "a.ply", "--where", *REGION, "--out", tmp_path / name)
        assert done.code == 0, done.err
        assert run(capfd, "verify", tmp_path / "a.ply", tmp_path / name).code == 0


@pytest.mark.parametrize(
    "words, line",
    [
        ([], "splatpainter pixelate: expected --where, the region that becomes unreadable, got none"),
        (["--where", "x=0..", "--color", "red"], "splatpainter pixelate: expected --color like #808080, got 'red'"),
        (
            ["--where", "x=0..", "--margin", "-1"],
            "splatpainter pixelate: expected --margin from 0 to 100, got -1",
        ),
        (["--where", "x=9.."], "splatpainter: --where x=9..: reaches none of 900 Gaussians; widen it"),
        (["--where", "x=0..", "--size", "1e-9"], "splatpainter: pixelate: expected cells of at least"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, capfd: Capture, words: list, line: str) -> None:
    write(tmp_path / "a.ply", ball(900))
    done = run(capfd, "pixelate", tmp_path / "a.ply", *words, "--out", tmp_path / "b.ply")
    assert done.error.startswith(line), done.err
    assert not (tmp_path / "b.ply").exists()
