"""`.cube` tables: known functions come back, and every damaged line is named."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from splatpainter.grading.cube_lut import MAX_3D_SIZE, parse_cube, read_cube


def cube_text(table: np.ndarray, *head: str) -> str:
    """A 3D table [B, G, R, 3] as a file has it."""
    rows = "\n".join(" ".join(f"{value:.7g}" for value in row) for row in table.reshape(-1, 3))
    return "\n".join(['TITLE "a # b"', "# a comment", *head, f"LUT_3D_SIZE {len(table)}", "", rows, ""])


def lattice(size: int) -> np.ndarray:
    """[B, G, R, 3] the identity."""
    steps = np.linspace(0, 1, size)
    blue, green, red = np.meshgrid(steps, steps, steps, indexing="ij")
    return np.stack([red, green, blue], -1)


def some_colors(count: int = 300) -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 1, (count, 3)).astype(np.float32)


def test_the_identity_changes_nothing_and_red_runs_fastest() -> None:
    colors = some_colors()
    np.testing.assert_allclose(parse_cube(cube_text(lattice(9)), "id.cube")(colors), colors, atol=1e-6)
    swapped = lattice(5)[..., [2, 1, 0]]
    np.testing.assert_allclose(parse_cube(cube_text(swapped), "swap.cube")(colors), colors[:, ::-1], atol=1e-6)


def test_entries_come_back_exactly_and_tetrahedra_keep_greys_grey() -> None:
    table = np.random.default_rng(0).uniform(0, 1, (4, 4, 4, 3)).astype(np.float32)
    corners = lattice(4).reshape(-1, 3)
    np.testing.assert_allclose(parse_cube(cube_text(table), "x.cube")(corners), table.reshape(-1, 3), atol=1e-6)
    for k in range(4):
        table[k, k, k] = table[k, k, k, 0]  # the diagonal is grey, all around it is not
    greys = parse_cube(cube_text(table), "x.cube")(np.repeat(np.linspace(0, 1, 50)[:, None], 3, 1))
    np.testing.assert_allclose(greys.max(1), greys.min(1), atol=1e-6)


def test_a_smooth_function_agrees_with_scipy_between_the_entries() -> None:
    size, colors = 17, some_colors()
    table = lattice(size) ** [1.4, 0.9, 1.1]
    steps = np.linspace(0, 1, size)
    from scipy.interpolate import RegularGridInterpolator

    expected = RegularGridInterpolator((steps,) * 3, table)(colors[:, ::-1])
    np.testing.assert_allclose(parse_cube(cube_text(table), "g.cube")(colors), expected, atol=2e-3)


def test_one_column_per_channel_and_domains() -> None:
    text = "LUT_1D_SIZE 3\nDOMAIN_MIN 0 0 0\nDOMAIN_MAX 2 1 1\n0 1 0\n0.5 0.25 0.5\n1 0 1\n"
    out = parse_cube(text, "one.cube")(np.array([[1.0, 0.25, 0.75]]))
    np.testing.assert_allclose(out, [[0.5, 0.625, 0.75]], atol=1e-6)


def test_a_shaper_before_a_cube_as_resolve_writes_it() -> None:
    rows = [" ".join(map(str, entry[::-1])) for entry in itertools.product((0, 1), repeat=3)]
    head = ["LUT_1D_SIZE 2", "LUT_1D_INPUT_RANGE 0 0.5", "LUT_3D_SIZE 2", "LUT_3D_INPUT_RANGE 0 1", "0 0 0", "1 1 1"]
    out = parse_cube("\n".join([*head, *rows]), "both.cube")(np.array([[0.1, 0.25, 0.4]]))
    np.testing.assert_allclose(out, [[0.2, 0.5, 0.8]], atol=1e-6)


@pytest.mark.parametrize(
    "text, line",
    [
        ("", "x.cube: expected a .cube table with LUT_1D_SIZE or LUT_3D_SIZE, got neither"),
        ("0 0 0\n", "x.cube:1: expected LUT_1D_SIZE or LUT_3D_SIZE before the entries, got '0 0 0'"),
        ("LUT_3D_SIZE 4096\n", f"x.cube:1: expected LUT_3D_SIZE from 2 to {MAX_3D_SIZE}, got 4096"),
        ("LUT_3D_SIZE 1e2\n", "x.cube:1: expected a whole number after LUT_3D_SIZE, got '1e2'"),
        ("LUT_3D_SIZE -3\n", "x.cube:1: expected a whole number after LUT_3D_SIZE, got '-3'"),
        ("LUT_1D_SIZE 2\nLUT_1D_SIZE 2\n", "x.cube:2: LUT_1D_SIZE was given twice"),
        ("LUT_1D_SIZE 2\n0 0 0\n# x\n0 nan 0\n", "x.cube:4: expected 3 numbers, got '0 nan 0'"),
        ("LUT_1D_SIZE 2\n0 0 0\n1 1\n", "x.cube:3: expected 3 numbers, got '1 1'"),
        ("LUT_1D_SIZE 2\n0 0 0\n", "x.cube: expected 2 entries, as its size says, got 1"),
        ("LUT_1D_SIZE 2\n0 0 0\n1 1 1\n1 1 1\n", "x.cube:4: expected 2 entries, as its size says, got '1 1 1'"),
        (
            "LUT_1D_SIZE 2\n0 0 0\nDOMAIN_MAX 1 1 1\n",
            "x.cube:3: expected keywords before the entries, got 'DOMAIN_MAX'",
        ),
        ("LUT_IN_VIDEO_RANGE\nLUT_1D_SIZE 2\n", "x.cube:1: unknown keyword 'LUT_IN_VIDEO_RANGE'; expected one of "),
        ("DOMAIN_MAX 0 1 1\nLUT_1D_SIZE 2\n0 0 0\n1 1 1\n", "x.cube: expected a domain whose highest input is above"),
        ("\n" * 20_000, "x.cube:10001: expected at most 10000 lines that are no entries"),
    ],
)
def test_a_damaged_table_is_one_line_that_says_where(text: str, line: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_cube(text, "x.cube")
    assert str(caught.value).startswith(line)


def test_other_bytes_are_no_table(tmp_path: Path) -> None:
    (tmp_path / "x.cube").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ValueError, match=r"x\.cube: expected a \.cube table \(text\), got other bytes"):
        read_cube(tmp_path / "x.cube")
    (tmp_path / "x.cube").write_bytes(b"\xef\xbb\xbfLUT_1D_SIZE 2\r\n0 0 0\r\n1 1 1\r\n")  # as Windows writes text
    colors = some_colors(9)
    np.testing.assert_allclose(read_cube(tmp_path / "x.cube")(colors), colors, atol=1e-6)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_titles_in_any_encoding_and_lines_with_any_end(encoding: str, end: str, tmp_path: Path) -> None:
    lines = ['TITLE "K\u00fchl"', "# W\u00e4rme", "LUT_1D_SIZE 2", "1 1 1", "0 0 0"]
    (tmp_path / "a.cube").write_bytes(end.join(lines).encode(encoding))
    table = read_cube(tmp_path / "a.cube").shaper
    assert table is not None and table.tolist() == [[1, 1, 1], [0, 0, 0]]


@pytest.mark.parametrize(("top", "scale"), [(255, 255), (1023, 1023), (4000, 4095)])
def test_a_table_of_integer_levels_is_refused(top: int, scale: int, tmp_path: Path) -> None:
    """Taken as colours every entry but black is white."""
    (tmp_path / "a.cube").write_text(f"LUT_1D_SIZE 2\n0 0 0\n{top} {top} {top}\n")
    with pytest.raises(
        ValueError, match=rf"a.cube: its entries are whole numbers up to {top}; .*: divide them by {scale}"
    ):
        read_cube(tmp_path / "a.cube")
    (tmp_path / "a.cube").write_text(f"LUT_1D_SIZE 2\n0 0 0\n{top} {top} {top}.5\n")
    assert read_cube(tmp_path / "a.cube").shaper is not None, "light"
