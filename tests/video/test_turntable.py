"""Turntables: what the films show, that their container is one, and what is refused."""

from __future__ import annotations

import io
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

import splatpainter as sp
from splatpainter.cameras import UPS, UpAxis, look_at
from splatpainter.io import read
from splatpainter.kernels import portable
from splatpainter.lights.light_set import axes_of, turned_sky
from splatpainter.lights.turning import turned_lights
from splatpainter.rendering import render
from splatpainter.video import mp4
from splatpainter.video.turntable import TurntableOptions, turn, turntable_bytes
from tests.support.cli_scenes import Capture, ball, run, saved

UP = (0.0, -1.0, 0.0)


def views(count: int, width: int = 48, height: int = 40, degrees: float = 360.0):
    first = look_at((1.0, -1.2, -3.0), (0, 0, 0), UP, width=width, height=height, fov=45, background=(0.1, 0.6, 0.2))
    return turn(first, np.zeros(3), UP, count, degrees)


def test_a_turn_keeps_height_distance_and_lens_and_closes() -> None:
    ring = views(8)
    first = look_at((1.0, -1.2, -3.0), (0, 0, 0), UP, width=48, height=40, fov=45)
    assert np.allclose(ring[0].world_to_camera, first.world_to_camera, atol=1e-9)
    positions = np.array([camera.position for camera in ring])
    assert np.allclose(positions[:, 1], -1.2) and np.allclose(np.linalg.norm(positions, axis=1), np.sqrt(11.44))
    steps = np.linalg.norm(positions - np.roll(positions, 1, 0), axis=1)
    assert np.allclose(steps, steps[0]), "the last frame is followed by the first"
    assert all((camera.fx, camera.width, camera.height) == (first.fx, 48, 40) for camera in ring)
    a, b = views(2, degrees=90)[1].position, views(2, degrees=-90)[1].position
    assert np.allclose(a[[0, 2]], -b[[0, 2]]) and np.isclose(a[[0, 2]] @ positions[0, [0, 2]], 0)
    sideways = np.cross(positions[0], a)
    assert sideways @ np.array(UP) > 0, "counter-clockwise seen from above"


@pytest.mark.parametrize("up", ["-y", "+z", "+y"])
def test_lights_turn_as_the_camera_does(up: UpAxis) -> None:
    center, axis = np.array([0.5, -0.25, 2.0]), UPS[up]
    position = center + np.array([1.0, 0.7, -2.0])
    seen = look_at(tuple(position), tuple(center), tuple(axis), width=48, height=40, fov=45)
    _, there = turn(seen, center, axis, 2, 50.0)
    spot = sp.Lamp("spot", tuple(position), target=tuple(center), sizes=(30.0,))
    sky = sp.sky("sunset")
    lights = sp.Lights(sky=sky, suns=(sp.Sun(20, 35),), lamps=(spot,), rotate=10, up=up)
    after = turned_lights(lights, 50.0, center)
    assert np.allclose(after.lamps[0].position, there.position) and np.allclose(after.lamps[0].target or (), center)
    # A sun stands where a camera of its azimuth does.
    first, second = (portable.matmul(one.suns[0].directions(), axes_of(up))[0] for one in (lights, after))
    around = look_at(tuple(center + 3 * first), tuple(center), tuple(axis), width=48, height=40, fov=45)
    assert np.allclose(turn(around, center, axis, 2, 50.0)[1].position, center + 3 * second)
    turned, alone = turned_sky(sky, axes_of(up), 60.0), turned_sky(sky, axes_of(up), after.rotate)
    assert np.allclose(turned, alone)


def test_a_film_of_turning_lights(tmp_path: Path, capfd: Capture) -> None:
    source, out = saved(tmp_path / "ball.ply"), tmp_path / "lights.webp"
    words = ["--sun", "90,20,#ffffff,2", "--turns", "lights", "--seconds", "1", "--fps", "4", "--size", "48"]
    assert run(capfd, "turntable", source, "--out", out, "--transparent", *words).code == 0
    with Image.open(out) as film:
        frames = []
        for one in ImageSequence.Iterator(film):
            frames.append(np.asarray(one.convert("RGBA")).astype(float))
    assert len(frames) == 4
    sides = []
    for one in frames:
        assert np.abs(one[..., 3] - frames[0][..., 3]).max() < 3, "the camera stands still"
        light = one[..., :3].mean(-1) * (one[..., 3] > 200)
        sides.append(light[:, 26:].sum() - light[:, :22].sum())
    assert sides[0] * sides[2] < 0, "a quarter before it comes from the one side, a quarter behind from the other"
    refused = run(capfd, "turntable", source, "--out", tmp_path / "x.webp", "--turns", "both")
    assert "expected lights for --turns both: --hdri, --sun or --rig" in refused.err


def decoded(data: bytes) -> np.ndarray:
    """[F, H, W, 3] uint8: the frames of an MP4, put back into an AVIF sequence, which Pillow reads."""
    samples = mp4.avif_samples(data)
    keys = np.array(samples.keys)
    assert keys[0] == 0
    out = [Image.open(io.BytesIO(avif_still(samples, frame))).convert("RGB") for frame in samples.keys]
    return np.stack([np.asarray(image) for image in out])


def avif_still(samples: mp4.CodedFrames, key: int) -> bytes:
    """One key frame as an AVIF picture (AVIF v1.1.0, section 2)."""
    full = lambda kind, *parts: mp4.box(kind, bytes(4), *parts)  # noqa: E731
    data = samples.frames[key]
    size = full(b"ispe", struct.pack(">II", samples.width, samples.height))
    pixels = full(b"pixi", bytes([3, 8, 8, 8]))
    properties = mp4.box(
        b"iprp", mp4.box(b"ipco", size, pixels, samples.entry),
        full(b"ipma", struct.pack(">IHB", 1, 1, 4), bytes([1, 2, 0x83, 4])),
    )  # fmt: skip
    entry = mp4.box(b"infe", struct.pack(">IHH", 2 << 24, 1, 0), b"av01", b"\0")

    def meta(offset: int) -> bytes:
        record = struct.pack(">BBHHHHII", 0x44, 0, 1, 1, 0, 1, offset, len(data))
        handler = full(b"hdlr", bytes(4), b"pict", bytes(13))
        information = full(b"iinf", struct.pack(">H", 1), entry)
        return full(b"meta", handler, full(b"pitm", b"\0\1"), full(b"iloc", record), information, properties)

    head = mp4.box(b"ftyp", b"avif", bytes(4), b"avifmif1miaf")
    return head + meta(len(head) + len(meta(0)) + 8) + mp4.box(b"mdat", data)


def test_an_mp4_shows_the_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its key frames, decoded by libavif's other half, against the renderer; sizes are even, times exact."""
    monkeypatch.setattr("splatpainter.video.turntable.KEY_INTERVAL", 3)
    splats, cameras = ball(400), views(7, 49, 41)
    seen: list[tuple[int, int]] = []
    data = turntable_bytes(splats, cameras, TurntableOptions(seconds=1, fps=24), lambda *at: seen.append(at))
    assert seen == [(k, 7) for k in range(7)], "each frame is drawn once, in order"
    samples = mp4.avif_samples(data)
    assert (samples.width, samples.height, len(samples.frames), samples.keys) == (48, 40, 7, (0, 2, 4))
    assert data[4:12] == b"ftypiso6" and data.index(b"moov") < data.index(b"mdat")
    timing = data.index(b"stts") + 8
    assert struct.unpack_from(">III", data, timing) == (1, 7, 1)
    assert struct.unpack_from(">I", data, data.index(b"mdhd") + 16) == (24,)
    for picture, camera in zip(decoded(data), cameras[:5:2], strict=True):
        truth = np.clip(render(splats, camera).colors[0], 0, 1)[:40, :48]
        assert np.abs(picture / 255 - truth).mean() < 0.03
        assert np.abs(picture[0, 0] / 255 - camera.background).max() < 0.02


def test_a_webp_loops_at_its_rate_and_can_be_transparent() -> None:
    splats, cameras = ball(400), views(7)
    for clear in (False, True):
        data = turntable_bytes(splats, cameras, TurntableOptions("webp", fps=30, transparent=clear, quality=95))
        film = Image.open(io.BytesIO(data))
        assert (film.n_frames, film.size, film.info["loop"]) == (7, (48, 40), 0)  # type: ignore[attr-defined]
        pixels = np.asarray(film.convert("RGBA")) / 255
        drawn = render(splats, replace(cameras[0], background=(0, 0, 0)) if clear else cameras[0])
        alpha = drawn.alphas[0]
        assert (
            np.abs(pixels[..., :3] * (pixels[..., 3:] if clear else 1) - np.clip(drawn.colors[0], 0, 1)).mean() < 0.02
        )
        assert np.abs(pixels[..., 3:] - alpha).max() < 0.03 if clear else pixels[..., 3].min() == 1
        ends = 0
        for k in range(7):
            film.seek(k)
            film.load()
            ends += film.info["duration"]
        assert ends == 233, "seven frames of 33 1/3 ms, without drift"


def test_what_no_turntable_can_be() -> None:
    for fields, words in (
        ({"seconds": 0}, "seconds from"),
        ({"seconds": float("nan")}, "seconds from"),
        ({"fps": 1e9}, "frames per second"),
        ({"quality": 0}, "quality"),
        ({"seconds": 600, "fps": 60}, "2 to 7200 frames"),
        ({"transparent": True}, "no transparency"),
        ({"format": "gif"}, "mp4 or webp"),
    ):
        with pytest.raises(ValueError, match=words):
            TurntableOptions(**fields)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="cameras of one size"):
        turntable_bytes(ball(50), [*views(2), *views(2, 20)], TurntableOptions())


def test_damaged_sequences_are_errors_of_one_line() -> None:
    data = turntable_bytes(ball(50), views(3), TurntableOptions())
    rng = np.random.default_rng(0)
    for cut in (0, 7, 30, 200, len(data) // 2, len(data) - 1):
        with pytest.raises(ValueError, match="AVIF sequence") as error:
            mp4.avif_samples(data[:cut])
        assert "\n" not in str(error.value)
    index = data.index(b"mdat")
    for _ in range(300):
        broken = bytearray(data)
        broken[rng.integers(0, index)] = rng.integers(256)
        try:
            assert sum(map(len, mp4.avif_samples(bytes(broken)).frames)) <= 64 * len(data)
        except ValueError as error:
            assert str(error).startswith("AVIF sequence:") and "\n" not in str(error)


def test_the_command_writes_films(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.ply", ball(200))
    words = ["--seconds", 0.2, "--fps", 25, "--size", 48]
    done = run(capfd, "turntable", asset, "--out", tmp_path / "a.mp4", *words, "--json").json
    assert (done["frames"], done["width"], done["output"]["bytes"]) == (5, 48, (tmp_path / "a.mp4").stat().st_size)
    assert len(mp4.avif_samples((tmp_path / "a.mp4").read_bytes()).frames) == 5
    wide = ["--fps", 20, "--seconds", 0.1, "--width", 60, "--height", 33, "--background", "#ff0000"]
    assert run(capfd, "turntable", asset, "--out", tmp_path / "b.webp", *wide).code == 0
    with Image.open(tmp_path / "b.webp") as film:
        corner = np.asarray(film.convert("RGB")).astype(int)[0, 0]
        assert film.size == (60, 33) and np.abs(corner - (255, 0, 0)).max() < 4
    camera = tmp_path / "cam.json"
    camera.write_text(views(1)[0].to_json())
    assert run(capfd, "turntable", asset, "--out", tmp_path / "c.webp", "--camera", camera, *words[:4]).code == 0
    with Image.open(tmp_path / "c.webp") as film:
        first = np.asarray(film.convert("RGB")) / 255
    assert np.abs(first - np.clip(render(read(asset), views(1)[0]).colors[0], 0, 1)).mean() < 0.03
    for out, more, line in (
        ("a.mp4", [], "already exists"),
        ("a.gif", [], "ending in .mp4 or .webp"),
        ("d.mp4", ["--transparent"], "no transparency"),
        ("d.mp4", ["--width", 40], "--width and --height together"),
        ("d.mp4", ["--degrees", "nan"], "--degrees"),
    ):
        assert line in run(capfd, "turntable", asset, "--out", tmp_path / out, *words[:4], *more).error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mp4", "b.webp", "ball.ply", "c.webp", "cam.json"]
