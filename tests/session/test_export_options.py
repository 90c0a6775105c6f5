"""Exports with options: the file, its receipt, and the proof of both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.io import FORMATS, read, write
from splatpainter.io.write_options import WriteOptions
from splatpainter.receipts import Receipt, prove, verify
from splatpainter.session import Session
from splatpainter.session.project.asset_files import receipt_between
from tests.support.io_assets import random_splats


def ending(key: str) -> str:
    return FORMATS[key].suffixes[0]


@pytest.mark.parametrize("start", ["ply", "spz", "sog", None])
@pytest.mark.parametrize(
    "target",
    [
        ("spz", WriteOptions(sh_degree=1, spz_version=4, sh_bits=5)),
        ("sog", WriteOptions(sh_degree=2, sh_palette=64)),
        ("ply", WriteOptions(sh_degree=0, antialiased=True)),
    ],
)
def test_a_session_exports_with_options_and_its_receipt_proves_it(
    start: str | None, target: tuple[str, WriteOptions], tmp_path: Path
) -> None:
    key, options = target
    original = random_splats(200, 3)
    if start is not None:
        write(tmp_path / f"a{ending(start)}", original)
        original = read(tmp_path / f"a{ending(start)}")
    with Session(original) as session:
        session.layers.add("look", look="gain", settings={"gain": [0.9, 1, 1]})
        out = tmp_path / f"out{ending(key)}"
        receipt, proof = session.files.export(out, options=options)
        assert proof.ok and receipt.options == options
        assert session.files.exported().sh_degree == 3, "the session keeps all"
        written = read(out)
        assert written.sh_degree == options.sh_degree
        assert written.antialiased == (options.antialiased is True)
        assert f"SH above degree {options.sh_degree} was left out (the asset has degree 3)" in receipt.note
        text = (tmp_path / f"out{ending(key)}.receipt.json").read_text()
        assert Receipt.from_json(text).options == options
        if start is not None:
            again = verify(tmp_path / f"a{ending(start)}", out, Receipt.from_json(text))
            assert again.ok and again.changed == len(receipt.touched), again.problems
            other = replace(Receipt.from_json(text), options=WriteOptions())
            assert not verify(tmp_path / f"a{ending(start)}", out, other).ok, "without the options it is another file"


def test_fine_paint_on_an_asset_without_a_file_proves_itself_as_spz(tmp_path: Path) -> None:
    """Small Gaussians make the positions of all rows finer in a new SPZ file."""
    original = random_splats(100, 0)
    small = original.take(np.arange(20))
    edited = original.append(replace(small, scales=small.scales * np.float32(1e-3)))
    write(tmp_path / "fine.spz", edited)
    receipt, proof = prove(original, tmp_path / "fine.spz", receipt_between(original, edited, "compact", ""))
    assert proof.ok and proof.appended == 20 and "rounded anew by spz" in receipt.note


def test_hidden_gaussians_and_bands_go_together(tmp_path: Path) -> None:
    with Session(random_splats(300, 2)) as session:
        weights = np.zeros(300, np.float32)
        weights[:100] = 1
        session.layers.hide_selected(weights)
        out = tmp_path / "less.spz"
        receipt, proof = session.files.export(out, remove_hidden=True, options=WriteOptions(sh_degree=1))
        assert proof.ok and (len(read(out)), read(out).sh_degree) == (200, 1)
        assert receipt.dropped is not None and receipt.dropped["left_out"] == 100
        assert "100 hidden Gaussians were removed for good" in receipt.note and "SH above degree 1" in receipt.note
        assert len(session.files.exported(remove_hidden=True)) == 200 and len(session.files.exported()) == 300
        with pytest.raises(ValueError, match="b.splat: sh_degree is not an option of this format"):
            session.files.export(tmp_path / "b.splat", options=WriteOptions(sh_degree=0))
