"""Change the colours of a part: warmer above the middle, everything else byte for byte as it was."""

import sys
from pathlib import Path

import numpy as np

import splatpainter as sp


def main(asset: Path, folder: Path) -> None:
    splats = sp.read(asset)
    middle = float(np.median(splats.means[:, 1]))
    upper = sp.Region.parse([f"y=..{middle:g}"])  # the words of --where; y points down
    warm = sp.GradeSettings(temperature=0.5, exposure=0.2)
    edited = sp.adjust(splats, warm, upper)
    sp.write(folder / "warm.ply", edited.splats)
    above = splats.means[:, 1] < middle
    assert above[edited.receipt.touched].all()
    print(f"{len(edited.receipt.touched)} Gaussians above y = {middle:.3g} are warmer")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
