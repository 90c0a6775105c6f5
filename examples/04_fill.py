"""Take something away, and close the hole that it leaves."""

import sys
from pathlib import Path

import numpy as np

import splatpainter as sp


def main(asset: Path, folder: Path) -> None:
    splats = sp.read(asset)
    center = np.median(splats.means, axis=0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.98))
    # What is to go: a round patch around a Gaussian near the front. In a program this is a selection.
    front = np.argsort(-splats.means[:, 2])[len(splats) // 50]
    removed = np.linalg.norm(splats.means - splats.means[front], axis=1) < 0.25 * radius
    filled = sp.fill(splats, removed)
    sp.write(folder / "filled.ply", filled.splats)
    print(filled.receipt.note)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
