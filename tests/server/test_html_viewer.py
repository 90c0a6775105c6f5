"""The page of its own, without a browser: what is packed, what is refused, what the command line makes."""

from __future__ import annotations

import base64
import gzip
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.io import FORMATS, write
from splatpainter.io.size_estimate import estimated_bytes
from splatpainter.server import html_viewer
from splatpainter.server.frames import unpack_sh
from tests.support.cli_scenes import Capture, run, saved
from tests.support.studio_scenes import ball

CAMERA = look_at((0, 0, -3), (0, 0, 0), (0, -1, 0))


def quats_of(codes: np.ndarray) -> np.ndarray:
    """[N, 4] w, x, y, z as Spark's shader reads them: axis octahedral in 10 + 10 bits, angle in 12."""
    u, v = (codes & 1023) / 1023 * 2 - 1, (codes >> 10 & 1023) / 1023 * 2 - 1
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    axis = np.stack([u - np.sign(u) * fold, v - np.sign(v) * fold, z], 1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = (codes >> 20) / 4095 * np.pi / 2
    return np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * axis], 1)


def tables(data: bytes, count: int, coefficients: int) -> list[np.ndarray]:
    out, at = [], 0
    for dtype, width in (("<f4", 3), ("<f2", 1), ("<f2", 3), ("<u4", 1), ("<f2", 3), ("<u4", coefficients - 1)):
        size = np.dtype(dtype).itemsize * width
        planes = np.frombuffer(data, np.uint8, size * count, at).reshape(size, count)
        out.append(np.ascontiguousarray(planes.T).view(dtype).reshape(count, width))
        at += size * count
    assert at == len(data) == count * html_viewer.row_bytes(coefficients)
    return out


def test_what_is_packed_is_the_asset_as_screens_hold_it() -> None:
    splats = ball(300)
    means, opacities, scales, rotations, base, codes = tables(html_viewer.packed_gaussians(splats), 300, 4)
    assert np.array_equal(means, splats.means)
    assert np.abs(opacities[:, 0] - splats.opacities).max() < 1e-3
    assert np.abs(np.exp(scales.astype(float)) / splats.scales - 1).max() < 4e-3
    quats = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    assert np.abs((quats_of(rotations[:, 0]) * quats).sum(1)).min() > 1 - 1e-5
    assert np.abs(unpack_sh(base, codes) - splats.sh).max() < 2e-3


def test_gaussians_that_cannot_be_drawn_are_packed_empty() -> None:
    splats = ball(20)
    scales = splats.scales.copy()
    scales[3], scales[4] = 0, np.inf
    tables_of = tables(html_viewer.packed_gaussians(replace(splats, scales=scales)), 20, 4)
    assert np.isfinite(np.concatenate([table.astype(float).ravel() for table in tables_of[:3]])).all()
    assert (tables_of[1][3:5] == 0).all() and (tables_of[1] == 0).sum() == 2
    one = replace(splats, sh=splats.sh[:, :1])
    assert tables(html_viewer.packed_gaussians(one), 20, 1)[5].size == 0


def test_a_page_that_would_be_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(html_viewer, "MAX_BYTES", 1000)
    with pytest.raises(ValueError, match=r"expected at most 0 MB of Gaussians, got 0; export an \.spz"):
        html_viewer.html_viewer(ball(30), CAMERA, (0, -1, 0), "ball")


def test_an_unbuilt_page_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(html_viewer, "STATIC", tmp_path)
    with pytest.raises(ValueError, match="the page is not built"):
        html_viewer.html_viewer(ball(30), CAMERA, (0, -1, 0), "ball")


def test_convert_makes_a_page(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.ply")
    done = run(capfd, "convert", asset, tmp_path / "ball.html", "--json").json
    text = (tmp_path / "ball.html").read_text()
    assert done["output"]["bytes"] == len(text.encode()) and "default-src 'none'" in text
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', text).group(1))  # type: ignore[union-attr]
    assert (scene["name"], scene["count"], scene["up"]) == ("ball.ply", done["input"]["rows"], [0, -1, 0])
    packed = base64.b64decode(re.search(r'id="gaussians">(.*?)</script>', text).group(1))  # type: ignore[union-attr]
    assert len(gzip.decompress(packed)) == scene["count"] * html_viewer.row_bytes(scene["coefficients"])
    assert "already exists" in run(capfd, "convert", asset, tmp_path / "ball.html").error
    assert "no axes" in run(capfd, "convert", asset, tmp_path / "b.html", "--axes", "rub").error


@pytest.mark.parametrize("count", [700, 40_000])
def test_sizes_are_told_without_writing(count: int, tmp_path: Path) -> None:
    """The palettes of SOG and the streams of SPZ grow slower than the asset: within a tenth, others to the byte."""
    splats = ball(count)
    for key, entry in FORMATS.items():
        if entry.write is None or (key == "sog" and count > 1000):
            continue
        path = tmp_path / f"a{entry.suffixes[0]}"
        write(path, splats)
        size = path.stat().st_size
        slack = 0 if count < 1000 else 0.1 if key == "spz" else 0.001
        assert abs(estimated_bytes(splats, entry.suffixes[0]) - size) <= slack * size, key
    page = len(html_viewer.html_viewer(splats, CAMERA, (0, -1, 0), "ball"))
    assert abs(html_viewer.estimated_html_bytes(splats) / page - 1) < 0.05
    with pytest.raises(ValueError, match="can be written"):
        estimated_bytes(splats, ".ksplat")
