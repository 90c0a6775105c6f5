"""Paint on a picture of an asset, and the asset itself changes."""

import sys
from pathlib import Path

import numpy as np

import splatpainter as sp


def main(asset: Path, folder: Path) -> None:
    splats = sp.read(asset)
    center = np.median(splats.means, axis=0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.98))
    # A camera as any viewer has it; captures are y-down, so -y is up.
    camera = sp.look_at(center + (0, -0.4 * radius, 3 * radius), center, up=(0, -1, 0), width=384, height=384)
    picture = sp.render(splats, camera).colors[0]
    picture[180:220, 150:235] = (0.9, 0.1, 0.1)  # any edit of the picture, by any program
    edited = sp.edit(splats, [(picture, camera)])
    sp.write(folder / "painted.ply", edited.splats)
    # Every Gaussian that the receipt does not list has the bytes that it had.
    assert sp.verify(asset, folder / "painted.ply", edited.receipt).ok
    print(f"{len(edited.receipt.touched)} of {len(splats)} Gaussians changed, {edited.receipt.appended_rows} are new")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
