"""Lay a word on the surface: it bends with it, and is painted from as many sides as it needs."""

import sys
from pathlib import Path

import numpy as np

import splatpainter as sp
from splatpainter.decals.decals import text_picture


def main(asset: Path, folder: Path) -> None:
    splats = sp.read(asset)
    center = np.median(splats.means, axis=0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.98))
    camera = sp.look_at(center + (0, -0.4 * radius, 3 * radius), center, up=(0, -1, 0), width=384, height=384)
    word = text_picture("hello", (0.1, 0.2, 0.5))
    decal = sp.Decal(word, at=(192, 192), camera=camera, width="25%", angle=10)
    painter = sp.Painter.load()
    original = sp.Asset(splats)
    laid = decal.laid(original)  # one to six edited views, like any others
    edited = painter.apply(original, list(laid.edits))
    sp.write(folder / "lettered.ply", edited.splats)
    print(laid.note)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
