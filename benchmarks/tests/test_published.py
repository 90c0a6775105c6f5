"""The paper's own figures, against numbers copied from its tables by hand."""

from __future__ import annotations

import pytest
from splatbench.report import published
from splatbench.report.published import EDITED, OUTSIDE


def figures(protocol: str, label: str, group: str = "") -> tuple[float, ...]:
    (row,) = [row for row in published.rows(protocol) if row.label == label]
    return tuple(row.figures[group, name] for name in ("PSNR", "SSIM", "LPIPS"))


@pytest.mark.parametrize(
    ("protocol", "label", "group", "copied"),
    [
        ("refine", "GenDen", "", (17.32, 0.5378, 0.5979)),
        ("refine", "SRGS", "", (21.01, 0.6759, 0.3540)),
        ("refine", "Ours (stage II)", "", (21.07, 0.5780, 0.3673)),
        ("relight", "3DGS", "", (21.32, 0.8613, 0.1225)),
        ("relight", "Ours (2 views)", "", (24.71, 0.8991, 0.0719)),
        ("creative", "VineDresser3D", EDITED, (11.99, 0.6092, 0.3506)),
        ("creative", "VineDresser3D", OUTSIDE, (15.79, 0.7437, 0.2678)),
        ("creative", "Ours", OUTSIDE, (33.02, 0.9560, 0.0310)),
        ("compress", "VoxelAtt", "", (30.65, 0.9193, 0.0804)),
        ("compress", "Pre-Compression (GS-LRM)", "", (34.19, 0.9283, 0.0249)),
    ],
)
def test_figures_are_the_papers(protocol: str, label: str, group: str, copied: tuple[float, ...]) -> None:
    assert figures(protocol, label, group) == copied


def test_seconds_are_the_papers() -> None:
    seconds = {(row.protocol, row.label): row.seconds for row in published.ROWS}
    assert seconds["refine", "GS-LRM"] == "0.92" and seconds["refine", "SRGS"] == "495"
    assert seconds["refine", "Ours (stage II)"] == "1.54 + 0.64"
    assert seconds["relight", "RelitLRM"] == "22.1" and seconds["relight", "Ours (1 view)"] == "1.54 + 0.08"
    assert seconds["creative", "Ours"] == seconds["compress", "VoxelAtt"] == ""


def test_every_row_of_the_four_tables_is_there() -> None:
    counts = {name: len(published.rows(name)) for name in ("refine", "relight", "creative", "compress", "sequence")}
    assert counts == {"refine": 6, "relight": 6, "creative": 3, "compress": 4, "sequence": 0}
    assert {len(row.figures) for row in published.rows("creative")} == {6}
    # The column sums, added up by hand.
    assert sum(row.figures["", "PSNR"] for row in published.rows("refine")) == pytest.approx(121.04)
    assert sum(row.figures["", "PSNR"] for row in published.rows("relight")) == pytest.approx(141.35)
    assert sum(row.figures["", "PSNR"] for row in published.rows("compress")) == pytest.approx(132.70)


def test_rows_stand_beside_the_method_that_they_are() -> None:
    one = published.beside("relight", ["ttt", "3dgs"], 1)
    assert {method: row.label for method, row in one.items()} == {"ttt": "Ours (1 view)", "3dgs": "3DGS"}
    both = published.beside("relight", ["3dgs", "3dgs-colors"], 2)
    assert list(both) == ["3dgs-colors"], "the closest, and once"
    left = [row.label for row in published.unmatched("relight", ["ttt", "3dgs"], 4)]
    assert left == ["RelitLRM", "GS-LRM + CrossAtt"]
    assert published.beside("relight", ["ttt"], 3) == {}
