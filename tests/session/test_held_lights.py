"""Layers of light whose environment or rig was a file: the project holds what is needed of it, and opens no file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.image_files import bytes_to_png
from splatpainter.lights.held_skies import sky_of_png, sky_to_png
from splatpainter.lights.light_words import lamp_words, parse_lamp, parse_sun, sun_words
from splatpainter.lights.rig_files import write_rig
from splatpainter.lights.skies import sky
from splatpainter.lights.sky_maps import SkyMap, read_sky, write_sky
from splatpainter.painter import Asset
from splatpainter.session import Session
from tests.support.studio_scenes import ball


def large(name: str, rows: int = 300) -> SkyMap:
    """A sky of more pixels than a project holds, with grain, and a size that no number of pixels divides."""
    picture = sky(name).radiance
    at = np.arange(rows) * 64 // rows, np.arange(2 * rows + 10) * 128 // (2 * rows + 10)
    grain = np.random.default_rng(0).uniform(0.5, 1.5, (rows, 2 * rows + 10, 1))
    return SkyMap((picture[at[0]][:, at[1]] * grain).astype(np.float32), name)


def test_what_is_held_lights_as_the_file_does() -> None:
    original = large("sunset")
    data = sky_to_png(original)
    held = sky_of_png(data, "sunset.hdr")
    assert held.radiance.shape == (128, 256, 3) and len(data) < 200_000
    assert np.abs(held.coefficients() - original.coefficients()).max() < 2e-3
    small = sky_of_png(sky_to_png(sky("noon")), "noon.hdr")
    assert small.radiance.shape == (64, 128, 3)
    assert np.abs(small.coefficients() - sky("noon").coefficients()).max() < 1e-3
    for wrong in (b"", data[:300], bytes_to_png(b"another picture" * 100)):
        with pytest.raises(ValueError, match="the environment x.hdr: expected the picture of one"):
            sky_of_png(wrong, "x.hdr")


def test_a_layer_keeps_its_sky_and_its_source_when_the_files_are_gone(tmp_path: Path) -> None:
    write_sky(tmp_path / "sky.hdr", large("sunset"))
    write_sky(tmp_path / "studio.hdr", sky("studio"))
    light = sp.Relight(hdri=str(tmp_path / "sky.hdr"), rotate=40, source_light=tmp_path / "studio.hdr")
    direct = light.apply(Asset(ball())).splats
    with Session(ball(), tmp_path / "p.splatproj") as session:
        layer = session.layers.add(light, opacity=1.0)
        assert np.abs(session.splats.sh - direct.sh).max() < 5e-3
        assert layer.operation.record()["hdri"] == "sky.hdr" and str(tmp_path) not in str(layer.operation.record())
        session.files.export_layer(layer.id, tmp_path / "one.splatlayer")
        sh = session.splats.sh.copy()
    (tmp_path / "sky.hdr").unlink()
    (tmp_path / "studio.hdr").unlink()
    with Session(tmp_path / "p.splatproj") as again:
        assert (again.splats.sh == sh).all()
        preview = again.layers.color_preview(layer.id, exposure=0.5)
        again.layers.set(layer.id, exposure=0.5)
        assert preview is not None and np.abs(preview[1].sh[:, 0] - again.splats.sh[:, 0]).max() < 1e-4
        again.undo()
        assert (again.splats.sh == sh).all()
    with Session(ball(), tmp_path / "q.splatproj") as other:
        other.files.import_layer(tmp_path / "one.splatlayer")
        assert (other.splats.sh == sh).all()


@pytest.mark.parametrize("suffix", [".json", ".usda", ".glb"])
def test_a_rig_becomes_the_lights_in_it(tmp_path: Path, suffix: str) -> None:
    lights = sp.Lights(
        sky=None if suffix == ".glb" else read_sky(_written(tmp_path / "sky.hdr", sky("dawn"))),
        sky_intensity=2.0 if suffix != ".glb" else 1.0,
        suns=(sp.Sun(60, 10, 0.53 if suffix == ".glb" else 25.0, (1.2, 0.9, 0.5), 0.7),),
        lamps=(sp.Lamp("point", (1.0, -2.0, 0.0), (1.0, 0.5, 0.25), 3.0),),
    )
    write_rig(tmp_path / f"rig{suffix}", lights)
    light = sp.Relight(rig=str(tmp_path / f"rig{suffix}"))
    direct = light.apply(Asset(ball())).splats
    for path in tmp_path.glob("rig*.hdr"):
        assert path.exists()
    with Session(ball(), tmp_path / "p.splatproj") as session:
        operation = session.layers.add(light).operation.record()
        assert "rig" not in operation and len(operation["sun"]) == len(operation["point"]) == 1
        assert ("held" in operation) == (suffix != ".glb")
        assert np.abs(session.splats.sh - direct.sh).max() < 0.02  # colours of 8 bits


def test_lights_in_words_are_read_back() -> None:
    sun = sp.Sun(-30.5, 12.25, 30.0, (0.5, 1.25, 0.1), 2.0)
    back = parse_sun(sun_words(sun), 0.53)
    assert (back.azimuth, back.elevation, back.size) == (-30.5, 12.25, 30.0)
    assert np.allclose(np.array(back.color) * back.intensity, np.array(sun.color) * 2, atol=0.02)
    lamp = sp.Lamp("rect", (412345.125, -2.5, 1e-3), (1.0, 0.5, 0.0), 0.75, (412345.0, 0.0, 0.0), (2.0, 1.5))
    same = parse_lamp("rect", lamp_words(lamp))
    assert (same.position, same.target, same.sizes) == (lamp.position, lamp.target, lamp.sizes)
    warm = parse_lamp("point", "0,1,2,2700K,3")
    assert warm.intensity == 3 and warm.color[0] > 1 > warm.color[2]
    for wrong in ("0,1,2,99K", "0,1,2,K", "0,1,2,2700K,x"):
        with pytest.raises(ValueError, match="--point: expected"):
            parse_lamp("point", wrong)


def test_a_project_names_no_file_of_this_machine(tmp_path: Path) -> None:
    write_sky(tmp_path / "sky.hdr", sky("dawn"))
    with Session(ball(), tmp_path / "p.splatproj") as session:
        layer = session.layers.add(sp.Relight(hdri=str(tmp_path / "sky.hdr")))
        changes: tuple[dict[str, Any], ...] = (
            {"held": {}},  # whose name would then be opened
            {"held": {"rig": "0" * 64}},
            {"held": {"hdri": "sky.hdr"}},
            {"source_light": str(tmp_path / "sky.hdr")},
            {"rig": str(tmp_path / "sky.hdr")},
        )
        for wrong in changes:
            with pytest.raises(ValueError, match="expected"):
                session.layers.set(layer.id, **wrong)
        for light in (sp.Relight(match=(tmp_path / "sky.png",)), sp.Relight(hdri="sunset", balls=tmp_path / "b.png")):
            with pytest.raises(ValueError, match="without files, which a project does not hold"):
                session.layers.add(light)
        with pytest.raises(ValueError, match="no such file"):
            session.layers.add(sp.Relight(hdri=str(tmp_path / "none.hdr")))
        assert len(session.history) == 2


def _written(path: Path, environment: SkyMap) -> Path:
    write_sky(path, environment)
    return path


def test_only_options_that_can_be_held_are_declared_so() -> None:
    for kind in (sp.Relight, sp.Delight):
        assert {*kind.holds} <= {entry.name for entry in dataclasses.fields(kind)}
