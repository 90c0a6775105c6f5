"""Two assets in one file, each in its own range of rows, proved against the files that they came from."""

import sys
from pathlib import Path

import numpy as np

import splatpainter as sp


def main(asset: Path, folder: Path) -> None:
    splats = sp.read(asset)
    width = float(np.ptp(np.quantile(splats.means[:, 0], (0.02, 0.98))))
    beside = sp.Placement.of(move=(1.2 * width, 0, 0), turn=(0, 90, 0), scale=0.8)
    receipt = sp.merge([asset, asset], folder / "scene.ply", transforms=[None, beside])
    check = sp.verify_merge(folder / "scene.ply", [asset], receipt)
    assert check.ok
    for part in check.ranges:
        print(f"rows {part.first} to {part.first + part.rows - 1}: {part.file}, {part.how}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
