"""Layers, undo and a project file: what the studio does, without a screen."""

import sys
from pathlib import Path

import numpy as np

import splatpainter as sp


def main(asset: Path, folder: Path) -> None:
    with sp.Session(asset, project=folder / "example.splatproj") as session:
        splats = session.splats
        center = np.median(splats.means, axis=0)
        radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.98))
        camera = sp.look_at(center + (0, 0, 3 * radius), center, up=(0, -1, 0), width=256, height=256)
        picture = sp.render(splats, camera).colors[0]
        picture[110:140, 100:160] = (0.1, 0.6, 0.2)
        layer = session.layers.add("paint", [sp.Edit(picture, camera)], name="a green patch")
        session.layers.set(layer.id, opacity=0.5)
        session.undo()  # back to full opacity: every bit as before
        session.files.export(folder / "layered.ply")  # with its receipt, proved by reading both again
    # Everything is in one file, history and all.
    with sp.Session(folder / "example.splatproj") as session:
        session.redo()
        print([(layer.name, layer.opacity) for layer in session.layers])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
