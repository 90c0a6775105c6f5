"""GLB files of ours beside the Khronos extension: its JSON schema, the attribute table, and the Khronos validator.

The schema is Khronos' text, under terms of its own; SCHEMA says the same in our words, read off the extension's page
(KHR_gaussian_splatting, schema/mesh.primitive.KHR_gaussian_splatting.schema.json, as of July 2026).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from splatpainter import io
from splatpainter.io.formats.glb import write_glb
from tests.support.glb_files import KHR, attributes_of, build, pack, parts
from tests.support.io_assets import random_splats

pytest_plugins = ["tests.support.node_oracle"]

Validator = Callable[[Path], list[dict[str, Any]]]
SCHEMA = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "type": "object",
    "required": ["kernel", "colorSpace"],
    "properties": {
        **{name: {"type": "string"} for name in ("kernel", "colorSpace", "projection", "sortingMethod")},
        "extensions": {"type": "object", "additionalProperties": {"type": "object"}},
        "extras": True,
    },
}
"""Values are open (other extensions may add some); KNOWN are the base extension's."""
SPECIFIED = {
    "kernel": {"ellipse"},
    "colorSpace": {"srgb_rec709_display", "lin_rec709_display"},
    "projection": {"perspective"},
    "sortingMethod": {"cameraDistance"},
}
ATTRIBUTES = {"POSITION": "VEC3", f"{KHR}:ROTATION": "VEC4", f"{KHR}:SCALE": "VEC3", f"{KHR}:OPACITY": "SCALAR"}
COEFFICIENTS = [f"{KHR}:SH_DEGREE_{l}_COEF_{n}" for l in range(4) for n in range(2 * l + 1)]
EXPECTED = {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}


def check(path: Path, degree: int, validator: Validator) -> None:
    doc, _ = parts(path.read_bytes())
    assert KHR in doc["extensionsUsed"]
    primitives = [p for mesh in doc["meshes"] for p in mesh["primitives"] if KHR in p.get("extensions", {})]
    assert primitives
    for primitive in primitives:
        extension = primitive["extensions"][KHR]
        jsonschema.validate(extension, SCHEMA, jsonschema.Draft202012Validator)
        assert all(extension[key] in values for key, values in SPECIFIED.items() if key in extension)
        assert primitive["mode"] == 0
        expected = ATTRIBUTES | dict.fromkeys(COEFFICIENTS[: (degree + 1) ** 2], "VEC3")
        types = {name: doc["accessors"][index]["type"] for name, index in primitive["attributes"].items()}
        assert {name: types.get(name) for name in expected} == expected
        assert set(types) - set(expected) <= {"COLOR_0"}
    messages = validator(path)
    assert {message["code"] for message in messages} <= EXPECTED, messages
    strange = [m for m in messages if m["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and f"{KHR}:" not in m["pointer"]]
    assert not strange
    assert any(message["code"] == "UNSUPPORTED_EXTENSION" for message in messages)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("linear", [False, True])
def test_new_files(degree: int, linear: bool, tmp_path: Path, gltf_validator: Validator) -> None:
    splats = random_splats(50, degree)
    splats = replace(splats, color_space="linear" if linear else "srgb", antialiased=linear)
    write_glb(tmp_path / "a.glb", splats)
    check(tmp_path / "a.glb", degree, gltf_validator)


def test_edited_files(tmp_path: Path, gltf_validator: Validator) -> None:
    write_glb(tmp_path / "a.glb", random_splats(50, 1))
    splats = io.read(tmp_path / "a.glb")
    edited = replace(splats, sh=splats.sh * np.float32(0.5)).take(np.arange(3, 50))
    write_glb(tmp_path / "b.glb", edited.append(edited.take(np.arange(5))))
    check(tmp_path / "b.glb", 1, gltf_validator)


def test_an_extension_object_that_lacks_what_it_must_say_gets_it(tmp_path: Path) -> None:
    """Files of the drafts: the required properties come with the first edit."""
    data = build(attributes_of(random_splats(20, 0)), nodes=[{"mesh": 1}])
    doc, binary = parts(data)
    doc["meshes"].pop(0)
    doc["nodes"] = [{"mesh": 0}]
    del doc["meshes"][0]["primitives"][0]["extensions"][KHR]["kernel"]
    with pytest.raises(jsonschema.ValidationError, match="'kernel' is a required property"):
        jsonschema.validate(doc["meshes"][0]["primitives"][0]["extensions"][KHR], SCHEMA)
    (tmp_path / "a.glb").write_bytes(pack(doc, binary))
    splats = io.read(tmp_path / "a.glb")
    write_glb(tmp_path / "b.glb", replace(splats, opacities=np.full(20, 0.5, np.float32)))
    extension = parts((tmp_path / "b.glb").read_bytes())[0]["meshes"][0]["primitives"][0]["extensions"][KHR]
    jsonschema.validate(extension, SCHEMA, jsonschema.Draft202012Validator)
    assert extension["kernel"] == "ellipse"


def test_files_of_splat_transform(
    tmp_path: Path, splat_transform: Callable[..., str], gltf_validator: Validator
) -> None:
    """Its files are read as the asset they were made from, and saved with an edit they are valid."""
    truth = random_splats(50, 3)
    io.write(tmp_path / "a.ply", truth)
    splat_transform(tmp_path / "a.ply", tmp_path / "a.glb")
    splats = io.read(tmp_path / "a.glb")
    nearest = np.argmin(((splats.means[:, None] - truth.means[None]) ** 2).sum(-1), 1)
    assert np.abs(splats.means - truth.means[nearest]).max() < 1e-5
    assert np.abs(splats.sh - truth.sh[nearest]).max() < 1e-5
    write_glb(tmp_path / "b.glb", replace(splats, opacities=np.full(50, 0.5, np.float32)))
    check(tmp_path / "b.glb", 3, gltf_validator)
