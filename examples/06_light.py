"""New light on an asset: an evening sky and a low sun, by the ratio of the light before and after."""

import sys
from pathlib import Path

import splatpainter as sp


def main(asset: Path, folder: Path) -> None:
    splats = sp.read(asset)
    evening = sp.Lights(sky=sp.sky("sunset"), suns=(sp.Sun(60, 10, intensity=2),))
    lit = sp.light(splats, evening)
    sp.write(folder / "evening.ply", lit.splats)
    # Colours alone: the receipt lists what changed, and places and shapes have their bits.
    assert (lit.splats.means == splats.means).all()
    print(f"{len(lit.receipt.touched)} Gaussians under another light")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
