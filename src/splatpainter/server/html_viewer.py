"""An asset as one HTML file that shows it: the page's own viewer without the editor, and the Gaussians inside.

The file opens from disk and asks nothing of any network: its content security policy allows no request. Gaussians are
held as the screen's textures hold them (the same numbers as web/src/splats/texels.ts makes of floats), table after
table: means f32[N][3], opacities f16[N], logarithms of scales f16[N][3], rotations u32[N] (axis octahedral in
10 + 10 bits, angle in 12), base colours f16[N][3], codes of the other SH coefficients u32[N][K - 1] as in frames.py.
Each table lies plane by plane (all first bytes of its rows, all second ones, ...), which gzip likes; gzip, base64.
web/src/page/ reads it.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
from functools import cache
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera, bounding_sphere
from splatpainter.color import to_display
from splatpainter.io.size_estimate import sample
from splatpainter.server.frames import MAX_HALF, pack_base, pack_harmonics
from splatpainter.server.packed_files import STATIC, page_file
from splatpainter.splats import Splats

MAX_COEFFICIENTS = 16
"""Per Gaussian and channel, SH degree 3: the screen shows no more."""
HTML_OPTIONS = ("sh_degree", "antialiased")
"""Fields of io.WriteOptions that a page can follow."""
MAX_BYTES = 300_000_000
"""Most bytes of the packed Gaussians before base64: browsers hold no text above half a gigabyte in one element. Three
million Gaussians of SH degree 3, or ten of degree 0."""
GZIP_LEVEL = 6
SAMPLE_ROWS = 16384
"""Gaussians that are packed for an estimate."""
NOTICE = """Made with SplatPainter (Apache-2.0). Contains three.js (MIT, Copyright three.js authors), Spark (MIT,
  Copyright World Labs Technologies, Inc.) and fflate (MIT, Copyright Arjun Barrett): Permission is hereby granted, free
  of charge, to any person obtaining a copy of this software and associated documentation files, to deal in the Software
  without restriction, including without limitation the rights to use, copy, modify, merge, publish, distribute,
  sublicense, and/or sell copies of the Software, provided that the above copyright notices and this permission notice
  are included in all copies or substantial portions of the Software. THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY
  OF ANY KIND."""
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; connect-src data: blob:"
)
BOOT = """
const bytesOf = (id) => {
  const text = document.getElementById(id).textContent.trim();
  const out = new Uint8Array((text.length / 4) * 3 - (text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0));
  for (let at = 0, to = 0; at < text.length; at += 1 << 20) {
    const part = atob(text.slice(at, at + (1 << 20)));
    for (let k = 0; k < part.length; k++) out[to++] = part.charCodeAt(k);
  }
  return out;
};
const unpacked = async (id) => {
  const stream = new Blob([bytesOf(id)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
};
const script = (text) => URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
try {
  const decoder = new TextDecoder();
  const engine = script(decoder.decode(await unpacked("engine")));
  const page = decoder.decode(await unpacked("viewer"));
  const linked = page.replaceAll(/(["'`])\\.\\/engine\\.js\\1/g, JSON.stringify(engine));
  const { show, fail } = await import(script(linked));
  try {
    await show(JSON.parse(document.getElementById("scene").textContent), await unpacked("gaussians"));
  } catch (error) {
    console.error(error);
    fail(error);
  }
} catch (error) {
  console.error(error);
  document.body.textContent = "This browser cannot show the asset: it needs WebGL 2, as browsers since 2023 have it.";
}
"""


def html_viewer(splats: Splats, camera: Camera, up: tuple[int, int, int], name: str, *, turning: bool = False) -> bytes:
    """The HTML file. camera: the first view, whose background is the page's. up: world axis that is up when it is
    turned. name: shown, and the window's title. turning: whether it turns until it is touched.

    Raises ValueError: too many Gaussians, or the page is not built."""
    # The limit is checked on numbers alone, before anything is packed.
    degree_coefficients = min(splats.sh.shape[1], MAX_COEFFICIENTS)
    size = len(splats) * row_bytes(degree_coefficients)
    if size > MAX_BYTES:
        limit = f"{MAX_BYTES / 1e6:.0f} MB of Gaussians, got {size / 1e6:.0f}"
        raise ValueError(f"HTML: expected at most {limit}; export an .spz or .sog, which viewers of the web open")
    center, radius = bounding_sphere(splats)
    background = np.clip(to_display(np.array(camera.background), splats.color_space), 0, 1)
    # As the page's module reads it; Gaussians and scripts come as blocks of their own below.
    scene = {
        "name": name,
        "count": len(splats),
        "coefficients": degree_coefficients,
        "antialiased": splats.antialiased,
        "center": center.tolist(),
        "radius": radius,
        "up": list(up),
        "camera": camera.record(),
        "turning": turning,
    }
    color = "#" + "".join(f"{round(255 * value):02x}" for value in background.tolist())
    # A name of the user's stands in HTML and in a script element; neither may end the element it is in.
    title, described = html.escape(name), json.dumps(scene).replace("<", "\\u003c")
    # mtime=0 leaves the time out of gzip: the same asset gives the same file.
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8" />',
            '<meta name="viewport" content="width=device-width, initial-scale=1" />',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}" />',
            f"<title>{title}</title>",
            f"<!-- {NOTICE} -->",
            "</head>",
            f'<body style="background: {color}">',
            f'<script type="application/json" id="scene">{described}</script>',
            _block("engine", _script(STATIC / "engine.js")),
            _block("viewer", _script(STATIC / "viewer.js")),
            _block("gaussians", gzip.compress(packed_gaussians(splats), GZIP_LEVEL, mtime=0)),
            f'<script type="module">{BOOT}</script>',
            "</body>",
            "</html>",
            "",
        ]
    ).encode()


def estimated_html_bytes(splats: Splats) -> int:
    """Bytes of the HTML file, about: a sample of the Gaussians is packed."""
    # Scripts are the same in every file; base64 makes four characters of three bytes.
    fixed = 4 / 3 * sum(len(_script(STATIC / name)) for name in ("engine.js", "viewer.js"))
    some = sample(splats, SAMPLE_ROWS)
    packed = len(gzip.compress(packed_gaussians(some), GZIP_LEVEL)) / max(len(some), 1)
    return round(fixed + 4 / 3 * packed * len(splats))


def row_bytes(coefficients: int) -> int:
    """Bytes of one packed Gaussian."""
    return 12 + 2 + 6 + 4 + 6 + 4 * (coefficients - 1)


def packed_gaussians(splats: Splats) -> bytes:
    """The tables, see above. Gaussians that cannot be drawn get opacity 0."""
    splats = splats.numpy()
    drawable, count = splats.drawable, len(splats)
    # The screen shows no more coefficients, so none are stored.
    sh = splats.sh[:, :MAX_COEFFICIENTS]
    with np.errstate(all="ignore"):  # values of those that are not drawn
        logs = np.log(splats.scales.astype(np.float64))
        quats = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    # What cannot be drawn gets plain numbers: a NaN is nothing that a screen's tables should hold.
    means = np.where(drawable[:, None], splats.means, 0).astype("<f4")
    opacities = np.where(drawable, np.clip(splats.opacities, 0, 1), 0).astype("<f2")
    scales = np.clip(np.where(drawable[:, None], logs, 0), -MAX_HALF, MAX_HALF).astype("<f2")
    rotations = pack_rotations(np.where(drawable[:, None], quats, (1, 0, 0, 0))).astype("<u4")
    tables = (means, opacities, scales, rotations, pack_base(sh).astype("<f2"), pack_harmonics(sh).astype("<u4"))
    # Plane by plane: first bytes resemble one another more than the bytes of one number do, and gzip uses that.
    return b"".join(
        np.ascontiguousarray(table).reshape(count, -1).view(np.uint8).reshape(count, -1).T.tobytes()
        for table in tables
        if table.size
    )


def pack_rotations(quats: np.ndarray) -> np.ndarray:
    """[N, 4] unit quaternions (w, x, y, z) -> [N] uint32 as `encodeRotation` of web/src/splats/texels.ts."""
    # q and -q are one rotation; the half with w >= 0 leaves an angle of 0 to pi.
    w, x, y, z = (np.where(quats[:, 0] < 0, -1, 1) * quats.T.astype(np.float64)).astype(np.float64)
    sine = np.sqrt(x * x + y * y + z * z)
    angle = 2 * np.arctan2(sine, w)
    still = sine < 1e-6
    # Without a turn there is no axis; any will do, but 0 / 0 would not.
    x, y, z = np.where(still, 1, x), np.where(still, 0, y), np.where(still, 0, z)
    total = np.abs(x) + np.abs(y) + np.abs(z)
    u, v = x / total, y / total
    # Octahedral: the lower half of the sphere is folded over the upper one, so two numbers say the axis.
    fold = z < 0
    u, v = (
        np.where(fold, (1 - np.abs(v)) * np.where(u >= 0, 1, -1), u),
        np.where(fold, (1 - np.abs(u)) * np.where(v >= 0, 1, -1), v),
    )
    parts = (angle / np.pi * 4095, 20), ((v * 0.5 + 0.5) * 1023, 10), ((u * 0.5 + 0.5) * 1023, 0)
    code = np.zeros(len(quats), np.uint32)
    for value, shift in parts:
        code |= np.floor(value + 0.5).astype(np.uint32) << np.uint32(shift)
    return code


@cache
def _script(path: Path) -> bytes:
    """A script of the page, gzip."""
    try:
        return gzip.compress(page_file(path), GZIP_LEVEL, mtime=0)
    except OSError:
        raise ValueError("HTML: the page is not built: run npm ci && npm run build in web/") from None


def _block(id: str, data: bytes) -> str:
    return f'<script type="application/octet-stream" id="{id}">{base64.b64encode(data).decode()}</script>'
