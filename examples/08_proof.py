"""What a receipt proves, checked without this package's verifier: the bytes of rows, hashed by hand."""

import json
import sys
from pathlib import Path

import numpy as np

import splatpainter as sp


def main(asset: Path, folder: Path) -> None:
    splats = sp.read(asset)
    edited = sp.adjust(splats, sp.GradeSettings(saturation=-1), sp.Region.parse(["hue=300..60"]))
    sp.write(folder / "grey.ply", edited.splats)
    record = json.loads(edited.receipt.to_json())
    touched = np.zeros(len(splats), bool)
    touched[edited.receipt.touched] = True
    # A binary PLY: a header of text, then one record of fixed size for each row.
    old, new = (rows_of(path, len(splats)) for path in (asset, folder / "grey.ply"))
    assert (old[~touched] == new[~touched]).all(), "a row that the receipt does not list has other bytes"
    print(
        f"{(~touched).sum()} of {len(splats)} rows are byte-identical; keys of a receipt: {', '.join(sorted(record))}"
    )


def rows_of(path: Path, count: int) -> np.ndarray:
    """[N, B] uint8 of the first `count` rows behind the header."""
    data = path.read_bytes()
    body = np.frombuffer(data, np.uint8, offset=data.index(b"end_header\n") + len(b"end_header\n"))
    size = 4 * data[: data.index(b"end_header")].count(b"property float")
    return body[: count * size].reshape(count, size)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
