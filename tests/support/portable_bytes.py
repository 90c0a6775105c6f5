"""Hashes of what readers, fills and colour matches make, for a process whose numpy and BLAS take another way."""

from __future__ import annotations

import hashlib
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.decals.decals import Decal
from splatpainter.gatekeeper.bent_pictures import bend_of
from splatpainter.gatekeeper.color_drift import estimate_drift
from splatpainter.gatekeeper.registration import register, resampled_at, warped
from splatpainter.grading.color_match import AffineMap, monge_kantorovitch, statistics
from splatpainter.holes.fill import fill_hole
from splatpainter.io import read, write
from splatpainter.io.axes import move
from splatpainter.lift.options import LocalOptions
from splatpainter.painter import Edit, Painter
from splatpainter.painting.asset import Asset
from splatpainter.pictures.color_profiles import primaries_to_srgb
from splatpainter.rendering import render
from splatpainter.scene.placement import Placement
from splatpainter.session.measures.mirror_plane import find_mirror_plane
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats
from splatpainter.transforms import quat_to_matrix
from tests.support.surface_shapes import sphere

FORMATS = ("ply", "compressed.ply", "splat", "spz", "glb", "sog")


def bumpy_plate(side: int = 61) -> Splats:
    """Flat Gaussians on a bumpy sheet, many sizes and colours, SH degree 1."""
    rng = np.random.default_rng(3)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side)))
    count = len(x)
    means = np.stack([x, y, 0.1 * x * x - 0.07 * x * y + 0.01 * rng.random(count)], 1)
    quats = np.array([1, 0, 0, 0]) + 0.05 * rng.normal(size=(count, 4))
    scales = np.array([0.02, 0.02, 0.002]) * np.exp(0.2 * rng.normal(size=(count, 3)))
    sh = np.concatenate([(rng.random((count, 1, 3)) - 0.5) / SH_C0, rng.normal(0, 0.1, (count, 3, 3))], 1)
    values = (means, quats / np.linalg.norm(quats, axis=1)[:, None], scales, rng.uniform(0.3, 0.99, count), sh)
    # Rounded: exp and norm above may depend on the machine, what begins here may not.
    means, quats, scales, opacities, sh = (np.round(value, 5).astype(np.float32) for value in values)
    return Splats(means, quats, scales, opacities, sh)


def digest(splats: Splats) -> str:
    state = hashlib.sha256()
    for name in ATTRIBUTES:
        state.update(np.ascontiguousarray(getattr(splats, name)).tobytes())
    return state.hexdigest()[:16]


def laid_over() -> str:
    """What registration, bends and drifts of colour say of a picture that came back turned, bent and darker."""
    y, x = np.mgrid[:200, :240] / 40
    steps = (np.floor(x * k % 2) + np.floor(y * k % 3) for k in (1.0, 1.4, 0.8))
    render = np.round(np.stack([0.2 + 0.15 * one for one in steps], -1), 3).astype(np.float32)
    turned = np.array([[0.99, 0.02, -1.5], [-0.02, 0.99, 3]])
    bent = np.stack([x - 3, y - 2.5], -1) * ((x - 3) ** 2 + (y - 2.5) ** 2)[..., None] * 0.1
    darker = (0.8 * render).astype(np.float32)
    bend = bend_of(resampled_at(darker, bent)[0], render)
    assert bend is not None
    laid = register(warped(darker, turned, (240, 200))[0], render).matrix, bend.coefficients
    drift = estimate_drift(darker, render, np.ones(render.shape[:2], bool), certain=True)
    assert drift.kind != "none" and abs(laid[0][0, 1]) > 0.01
    return " ".join(hashlib.sha256(of.tobytes()).hexdigest()[:16] for of in (*laid, drift.matrix))


def decal() -> str:
    """A turned picture laid around a ball, which asks for cameras beside it; the plane in which the ball is its own
    mirror image; its colours as a picture of other primaries stores them."""
    made = sphere(900)
    rounded = {name: np.round(getattr(made, name), 5).astype(np.float32) for name in ATTRIBUTES}
    splats = replace(made, **rounded)
    camera = look_at((0.4, 0.3, 4), (0, 0, 0), (0, 1, 0), width=160, height=160, fov=38)
    picture = np.zeros((40, 90, 4), np.float32)
    picture[..., 0], picture[4:-4, 6:-6, 3] = 0.8, 1
    painter = Painter()
    asset = painter.encode(splats)
    edited = painter.apply(asset, Decal(picture, (84.0, 77.0), camera, 1.9, 25.0).views(asset)).splats
    plane = find_mirror_plane(splats, (0.0, 1.0, 0.0))
    stored = primaries_to_srgb((0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06))
    turn = Placement.of((0.1, 0.2, 0.3), (20.0, 30.0, -50.0), 1.3)
    text = repr((plane, stored.tolist(), turn, turn.turn)).encode()
    return f"{digest(edited)} {hashlib.sha256(text).hexdigest()[:16]}"


def corrected(asset: Splats) -> str:
    """Of a disk painted onto a plate in one view: corrected on its sheet, and where it is split."""
    camera = look_at((0.5, 0.4, 3.2), (0, 0, 0), (0, 1, 0), width=120, height=120, fov=40)
    picture = np.asarray(render(asset, camera).colors[0]).copy()
    y, x = np.mgrid[:120, :120]
    picture[(x - 55) ** 2 + (y - 64) ** 2 < 500] = 0.9, 0.2, 0.1
    digests = []
    for fine_px in (0.0, 1e3):
        painter = Painter().with_settings(local_options=LocalOptions(fine_px=fine_px))
        edited = painter.apply(Asset(asset), [Edit(picture, camera)])
        assert edited.receipt is not None and edited.receipt.method == "corrected"
        digests.append(digest(edited.splats))
    assert digests[0] != digests[1]
    return " ".join(digests)


def main() -> None:
    splats = bumpy_plate()
    with tempfile.TemporaryDirectory() as folder:
        for suffix in FORMATS:
            path = Path(folder, f"plate.{suffix}")
            write(path, splats)
            print(suffix, hashlib.sha256(path.read_bytes()).hexdigest()[:16], digest(read(path)))
    turn = quat_to_matrix(np.array([[0.8, 0.36, -0.48, 0.0]]))[0]
    print("turned", digest(move(splats, turn, 1.3, np.array([0.1, 0.2, -0.3]))))
    filled = fill_hole(splats, removed=((splats.means[:, :2] - [0.05, 0.1]) ** 2).sum(1) < 0.09)
    assert filled.appended is not None
    print("filled", digest(filled.appended))
    colors = 0.5 + SH_C0 * splats.sh[:, 0]
    (mean, one), (target, other) = statistics(colors, splats.opacities), statistics(colors**2, splats.scales[:, 0])
    matched = AffineMap(monge_kantorovitch(one, other), mean, target)
    print("laid over", laid_over())
    print("decal", decal())
    print("corrected", corrected(splats))
    print("matched", hashlib.sha256(repr(matched).encode()).hexdigest()[:16])


if __name__ == "__main__":
    sys.exit(main())
