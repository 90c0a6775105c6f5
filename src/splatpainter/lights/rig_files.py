"""Rigs: lights as files of our own (.json), of USD as text (.usda) and of glTF (.glb, .gltf), in and out."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

from splatpainter.cameras import UpAxis
from splatpainter.io import files
from splatpainter.kernels import portable
from splatpainter.lights.gltf_lights import glb_of, read_gltf_lights
from splatpainter.lights.lamps import Lamp, Sun
from splatpainter.lights.light_set import Lights
from splatpainter.lights.scene_lights import SceneSky, from_scene, sky_turn, to_scene
from splatpainter.lights.skies import SKIES, sky
from splatpainter.lights.sky_maps import SkyMap, read_sky, write_sky
from splatpainter.lights.studio_rigs import RIGS, studio_rig
from splatpainter.lights.usd_lights import read_usda, usda_text
from splatpainter.system import jsonio
from splatpainter.system.atomic import writing
from splatpainter.system.quick_dataclass import dataclass

RIG_SUFFIXES = (".json", ".usda", ".usd", ".glb", ".gltf")
WRITTEN_RIGS = (".json", ".usda", ".glb")
MAX_RIG_BYTES = 4 << 20


@dataclass(frozen=True)
class Rig:
    """What a .json holds: `Lights`, with the environment by its name or file (relative to the rig's folder)."""

    version: int = 1
    sky: str = ""
    sky_intensity: float = 1.0
    suns: tuple[Sun, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    rotate: float = 0.0
    exposure: float = 0.0
    fill: float | None = None
    add: bool = False
    up: UpAxis = "auto"


def read_rig(
    name: str | Path, up: UpAxis = "auto", full_range: bool = False, *, alone: bool = False
) -> tuple[Lights, list[str]]:
    """(lights, what was passed over) of a name of RIGS or a file. up: which way of the asset is up, where the file does
    not say; alone: a stranger's, whose environment in another file is passed over. Raises ValueError, one line that
    names the file."""
    if str(name) in RIGS:
        return replace(studio_rig(str(name)), up=up), []
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix not in RIG_SUFFIXES:
        kinds = ", ".join((*RIGS, *RIG_SUFFIXES))
        raise ValueError(f"{path}: expected a rig ({kinds}), got {suffix or 'no suffix'}")
    if suffix == ".json":
        return _read_json(path, full_range, alone)
    dome: SceneSky | None = None
    notes: list[str] = []
    if suffix in (".glb", ".gltf"):
        scene = read_gltf_lights(path)
    else:
        scene, dome, notes = read_usda(path)
    # Black lights cost a shadow map each and light nothing.
    dark = [light for light in scene if not light.intensity > 0 or not any(light.color)]
    notes += [f"the light {ascii(light.name)[1:-1]} is black and passed over" for light in dark]
    suns, lamps = from_scene([light for light in scene if light not in dark], up)
    lights = Lights(suns=suns, lamps=lamps, up=up)
    if dome is not None and dome.intensity > 0:
        if dome.file and alone:
            notes.append(_left_out(dome.file))
        elif dome.file:
            environment = read_sky(path.parent / dome.file, full_range)
            lights = replace(
                lights, sky=environment, sky_intensity=dome.intensity, rotate=(dome.rotate - sky_turn(up)) % 360
            )
        else:
            lights = replace(lights, fill=min(dome.intensity, 10.0))
    # A rig that lights nothing would make the asset black, as if that were asked for.
    if lights.sky is None and not suns and not lamps and not lights.fill:
        raise ValueError(f"{path}: expected a rig with lights, found none")
    return lights, notes


def write_rig(path: str | Path, lights: Lights, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[str]:
    """Writes .json, .usda or .glb; returns what that kind of file cannot hold. offset: of the asset, taken from the
    places of lamps in .usda and .glb. Raises ValueError: another suffix."""
    path = Path(path)
    suffix, losses = path.suffix.lower(), []
    if suffix == ".json":
        rig = Rig(sky=_name(lights.sky, path), **{k: getattr(lights, k) for k in _SHARED})
        _write(path, (json.dumps(jsonio.plain(rig), indent=2) + "\n").encode())
        return losses
    # Exposure goes into each light's intensity: USD and glTF have none for a whole scene.
    scene = to_scene(lights, offset)
    if suffix == ".usda":
        dome = None
        gain = float(portable.exp(lights.exposure * portable.log(2.0)))
        if lights.sky is not None:
            environment = lights.sky
            if not environment.path:  # a file of it beside the rig
                beside = path.with_name(f"{path.stem}_sky.hdr")
                write_sky(beside, environment)
                environment = replace(environment, path=str(beside))
            dome = SceneSky(_name(environment, path), lights.sky_intensity * gain, lights.rotate + sky_turn(lights.up))
        elif lights.fill_level:
            dome = SceneSky("", lights.fill_level * gain, 0.0)
        _write(path, usda_text(scene, dome).encode())
        return losses
    if suffix == ".glb":
        if lights.sky is not None or lights.fill_level:
            losses.append("glTF holds no environment and no fill")
        data, more = glb_of(scene)
        _write(path, data)
        return losses + more
    raise ValueError(f"{path}: expected a rig (.json, .usda, .glb), got {suffix or 'no suffix'}")


_SHARED = ("sky_intensity", "suns", "lamps", "rotate", "exposure", "fill", "add", "up")


def _left_out(file: str) -> str:
    return f"its environment is another file and left out: {ascii(Path(file).name)[1:-1]}"


def _read_json(path: Path, full_range: bool, alone: bool) -> tuple[Lights, list[str]]:
    data = files.read_head(path, MAX_RIG_BYTES + 1)
    rig = jsonio.build(Rig, jsonio.load_object(data, path, "a rig", MAX_RIG_BYTES), path, what="a rig", defaults=True)
    if rig.version != 1:
        raise ValueError(f"{path}: expected a rig of version 1, got {rig.version}")
    environment, notes = None, []
    if rig.sky and rig.sky not in SKIES and alone:
        notes = [_left_out(rig.sky)]
    elif rig.sky:
        environment = sky(rig.sky) if rig.sky in SKIES else read_sky(path.parent / rig.sky, full_range)
    lights = Lights(sky=environment, **{k: getattr(rig, k) for k in _SHARED})
    try:
        lights.check()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return lights, notes


def _write(path: Path, data: bytes) -> None:
    with writing(path) as file:
        file.write(data)


def _name(environment: SkyMap | None, rig: Path) -> str:
    if environment is None:
        return ""
    if not environment.path:
        return environment.name
    try:
        return Path(os.path.relpath(environment.path, rig.resolve().parent)).as_posix()
    except ValueError:  # another drive of Windows
        return Path(environment.path).resolve().as_posix()
