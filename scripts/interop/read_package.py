"""What a Python package reads of files: python read_package.py PROGRAM FOLDER NAME ...; one JSON object on stdout.

Runs in the trial's own environment, where our package is not: it prints each program's own numbers, activated.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

KEYS = {".compressed.ply": "compressed.ply", ".ply": "ply", ".splat": "splat", ".spz": "spz", ".sog": "sog"}


def record(means, quats, logs, logits, base, rest) -> dict:
    """quats w x y z; rest [N, K - 1, 3]."""
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-np.asarray(logits, np.float64).reshape(-1)))
    arrays = {
        "positions": means,
        "quats": quats,
        "scales": np.exp(np.asarray(logs, np.float64)),
        "opacities": opacities,
    }
    arrays |= {"base": base, "rest": rest}
    return {name: np.asarray(array, np.float64).tolist() for name, array in arrays.items()}


def ply_columns(data: bytes) -> dict:
    """Of a little-endian PLY of float properties."""
    head, body = data.split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    column = {name: table[:, k] for k, name in enumerate(names)}
    more = sum(name.startswith("f_rest_") for name in names)

    def stack(*columns: str) -> np.ndarray:
        return np.stack([column[name] for name in columns], 1) if columns else np.zeros((len(table), 0))

    rest = stack(*(f"f_rest_{k}" for k in range(more))).reshape(len(table), 3, more // 3).transpose(0, 2, 1)
    quats, logs = stack(*(f"rot_{k}" for k in range(4))), stack(*(f"scale_{k}" for k in range(3)))
    return record(stack("x", "y", "z"), quats, logs, column["opacity"], stack("f_dc_0", "f_dc_1", "f_dc_2"), rest)


def gsply(path: Path) -> dict:
    gsply = import_module("gsply")

    if path.suffix == ".spz":
        data = gsply.read_spz(str(path))
    elif path.suffix == ".ply":
        data = gsply.plyread(str(path))
    else:
        raise ValueError("is not a format of it")
    rest = np.zeros((len(data.means), 0, 3)) if data.shN is None else data.shN
    return record(data.means, data.quats, data.scales, data.opacities, data.sh0, rest)


def gaussforge(path: Path) -> dict:
    gaussforge = import_module("gaussforge")

    key = next((key for ending, key in KEYS.items() if path.name.endswith(ending)), None)
    if key is None:
        raise ValueError("is not a format of it")
    with quiet():
        answer = gaussforge.GaussForge().convert(path.read_bytes(), key, "ply")
    if answer.get("error"):
        raise ValueError(answer["error"])
    return ply_columns(answer["data"])


def usd_convert_gsplat(path: Path) -> dict:
    usd, geometry = import_module("pxr.Usd"), import_module("pxr.UsdGeom")

    if path.suffix not in (".ply", ".spz") or path.name.endswith(".compressed.ply"):
        raise ValueError("is not a format of it")
    target = path.with_name(f"{path.name}.usda")
    words = [sys.executable, "-m", "usd_convert_gsplat", "-i", str(path), "-o", str(target)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    if done.returncode:
        raise ValueError((done.stderr or done.stdout).strip().splitlines()[-1])
    stage = usd.Stage.Open(str(target))
    prim = next(prim for prim in stage.Traverse() if prim.GetAttribute("positions").HasValue())

    def values(name: str) -> Any:
        attributes = [prim.GetAttribute(key) for key in (name, f"{name}h")]
        return next(attribute.Get() for attribute in attributes if attribute and attribute.HasValue())

    positions = np.asarray(values("positions"), np.float64)
    matrix = np.array(geometry.Xformable(prim).ComputeLocalToWorldTransform(usd.TimeCode.Default()))
    world = positions @ matrix[:3, :3] + matrix[3, :3]
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in values("orientations")])
    sh = np.asarray(values("radiance:sphericalHarmonicsCoefficients"), np.float64)
    sh = sh.reshape(len(positions), -1, 3)
    out = {"positions": world, "opacities": np.asarray(values("opacities"), np.float64), "base": sh[:, 0]}
    if np.allclose(matrix[:3, :3], np.eye(3)):
        out |= {"quats": quats, "scales": np.asarray(values("scales"), np.float64), "rest": sh[:, 1:]}
    return {name: np.asarray(array).tolist() for name, array in out.items()}


def bpy(path: Path) -> dict:
    """Blender has no splats: a mesh of points, with a PLY's properties as attributes of its vertices."""
    bpy = import_module("bpy")

    if path.suffix not in (".ply", ".glb"):
        raise ValueError("is not a format of it")
    with quiet(), contextlib.redirect_stdout(sys.stderr):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        if path.suffix == ".ply":
            bpy.ops.wm.ply_import(filepath=str(path))
        else:
            bpy.ops.import_scene.gltf(filepath=str(path))
    mesh = max((one for one in bpy.context.scene.objects if one.type == "MESH"), key=lambda one: len(one.data.vertices))
    points = mesh.data.vertices
    if not points:
        raise ValueError("no points")
    positions = np.array([mesh.matrix_world @ one.co for one in points])
    if path.suffix == ".glb":  # its importer lays glTF's y up along z; taken back
        positions = positions[:, [0, 2, 1]] * (1, 1, -1)
    out = {"positions": positions.tolist()}
    attributes = mesh.data.attributes

    def values(name: str) -> list[float]:
        return [one.value for one in attributes[name].data]

    if "opacity" in attributes:
        out["opacities"] = (1 / (1 + np.exp(-np.array(values("opacity"))))).tolist()
        out["base"] = np.stack([values(f"f_dc_{k}") for k in range(3)], 1).tolist()
        out["scales"] = np.exp(np.stack([values(f"scale_{k}") for k in range(3)], 1)).tolist()
        out["quats"] = np.stack([values(f"rot_{k}") for k in range(4)], 1).tolist()
    return out


@contextlib.contextmanager
def quiet():
    """Without what C++ writes to stderr."""
    before, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(nothing)
        os.close(before)


PROGRAMS = {"gsply": gsply, "gaussforge": gaussforge, "usd-convert-gsplat": usd_convert_gsplat, "bpy": bpy}


def main(program: str, folder: str, *names: str) -> None:
    answers = {}
    for name in names:
        try:
            answers[name] = PROGRAMS[program](Path(folder) / name)
        except Exception as error:  # of another program: anything
            answers[name] = {"error": " ".join(str(error).split())[:160] or type(error).__name__}
    print(json.dumps(answers))


if __name__ == "__main__":
    main(*sys.argv[1:])
