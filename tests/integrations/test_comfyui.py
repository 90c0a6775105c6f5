"""ComfyUI's nodes against its conventions, with stand-ins for its types: schemas, cameras, edits, workflows."""

from __future__ import annotations

import asyncio
import importlib.util
import inspect
import json
import math
import sys
import types
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatpainter.cameras import look_at
from splatpainter.io import read
from splatpainter.operations.grade import Grade
from splatpainter.painter import Asset
from splatpainter.receipts import Receipt, verify
from splatpainter.source_edits import coverage
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball, saved
from tests.support.comfyui_types import SPLAT, comfy_api

FOLDER = Path(__file__).parents[2] / "integrations" / "comfyui"
CAMERA = {"position": {"x": 0.0, "y": 0.0, "z": 3.5}, "target": {"x": 0.0, "y": 0.0, "z": 0.0}, "fov": 40.0}
"""In front of the ball, as three.js has it: the camera looks down -z, which is +z of the splat."""


def load_pack(name: str) -> types.ModuleType:
    """The folder as ComfyUI loads it: a module of any name, from its path."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / "__init__.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pack() -> types.ModuleType:
    load_pack("comfyui_pack")
    return sys.modules["comfyui_pack.nodes"]


@pytest.fixture(scope="module")
def ops(pack: types.ModuleType) -> Any:
    return sys.modules["comfyui_pack.operations"]


@pytest.fixture(scope="module")
def values(pack: types.ModuleType) -> Any:
    return sys.modules["comfyui_pack.values"]


def splat_of(splats: Splats, counts: bool = False) -> SPLAT:
    """With `counts` also padded, as batches are."""
    arrays = (splats.means, splats.scales, splats.quats, splats.opacities[:, None], splats.sh)
    tensors = [torch.from_numpy(np.array(array))[None] for array in arrays]
    if not counts:
        return SPLAT(*tensors)
    padded = [torch.cat([tensor, torch.zeros_like(tensor[:, :7])], 1) for tensor in tensors]
    return SPLAT(*padded, counts=torch.tensor([len(splats)]))


@pytest.fixture(scope="module")
def splat() -> SPLAT:
    return splat_of(ball(1500))


# Schemas


def test_both_schemas_say_the_same(pack: types.ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules["comfyui_pack"]
    assert set(module.NODE_CLASS_MAPPINGS) == set(module.NODE_DISPLAY_NAME_MAPPINGS) == {n.id for n in pack.NODES}
    for name, loaded in comfy_api().items():
        monkeypatch.setitem(sys.modules, name, loaded)
    newer = load_pack("comfyui_pack_newer")
    assert not hasattr(newer, "NODE_CLASS_MAPPINGS")  # ComfyUI would take these and ask no further
    extension = asyncio.run(newer.comfy_entrypoint())
    classes = {cls.define_schema().node_id: cls for cls in asyncio.run(extension.get_node_list())}
    for name, old in module.NODE_CLASS_MAPPINGS.items():
        schema, inputs = classes[name].define_schema(), old.INPUT_TYPES()
        assert set(inputs) == {"required", "optional"} and old.CATEGORY == schema.category == "3d/splat/SplatPainter"
        for group in inputs:
            for slot in (slot for slot in schema.inputs if slot.optional == (group == "optional")):
                kind, options = inputs[group][slot.id]
                assert kind == (slot.values["options"] if slot.io_type == "COMBO" else slot.io_type)
                assert options.get("default") == slot.values.get("default")
        assert len(schema.inputs) == sum(map(len, inputs.values())) == len({slot.id for slot in schema.inputs})
        assert old.RETURN_TYPES == tuple(slot.io_type for slot in schema.outputs)
        assert old.RETURN_NAMES == tuple(slot.display_name for slot in schema.outputs)
        assert old.OUTPUT_NODE == schema.is_output_node and callable(getattr(old(), old.FUNCTION))


def test_every_input_is_one_of_the_function(pack: types.ModuleType) -> None:
    for node in pack.NODES:
        parameters = inspect.signature(node.function).parameters
        anything = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        for slot in node.inputs:
            assert slot.id in parameters or (anything and slot.optional), (node.id, slot.id)
        needed = {name for name, p in parameters.items() if p.default is p.empty and p.kind is not p.VAR_KEYWORD}
        assert needed <= {slot.id for slot in node.inputs if not slot.optional}


def test_types_that_an_older_version_does_not_name_are_custom_ones(
    pack: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, loaded in comfy_api(named=()).items():
        monkeypatch.setitem(sys.modules, name, loaded)
    schemas = sys.modules["comfyui_pack.schemas"]
    schema = schemas.v3_class(pack.NODES[0]).define_schema()
    assert [slot.io_type for slot in schema.inputs[:2]] == ["SPLAT", "LOAD3D_CAMERA"]
    result = schemas.v3_class(next(n for n in pack.NODES if n.id == "SplatPainterAddView")).execute(
        camera_info=CAMERA, width=64, height=48
    )
    assert result.result == ([{"camera_info": CAMERA, "width": 64, "height": 48}],)


# Values


def test_gaussians_come_and_go_unchanged(values: Any) -> None:
    splats = ball(300)
    for counts in (False, True):
        again = values.splats_of(splat_of(splats, counts))
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert (getattr(again, name) == getattr(splats, name)).all()
    two = splat_of(splats)
    two.positions = two.positions.repeat(2, 1, 1)
    with pytest.raises(ValueError, match="expected one splat, got a batch of 2"):
        values.splats_of(two)


def test_cameras_are_those_of_three_js(values: Any) -> None:
    """By the formulas of RenderSplat: the splat is the world turned half around x, pixel j is evaluated at j."""
    info = {
        "position": {"x": 1.0, "y": 2.0, "z": 3.0},
        "target": {"x": 0.2, "y": -0.1, "z": 0.4},
        "fov": 35.0,
        "zoom": 2.0,
    }
    camera = values.camera_of(info, 640, 480)
    expected = look_at((1, -2, -3), (0.2, 0.1, -0.4), (0, -1, 0), width=640, height=480, fov=35)
    np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-12)
    assert camera.fx == pytest.approx(2 * expected.fx) and (camera.cx, camera.cy) == (320.5, 240.5)
    tall = values.camera_of(info, 480, 640)
    assert tall.fx == pytest.approx(camera.fx)  # the fov spans the shorter side


def test_a_quaternion_wins_and_may_roll(values: Any) -> None:
    half = math.radians(30) / 2
    info = {**CAMERA, "quaternion": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}}
    upright, rolled = values.camera_of(CAMERA, 64, 64), values.camera_of(info, 64, 64)
    np.testing.assert_allclose(rolled.forward, upright.forward, atol=1e-12)
    angle = math.degrees(math.acos(rolled.world_to_camera[0, :3] @ upright.world_to_camera[0, :3]))
    assert angle == pytest.approx(30)
    again = values.camera_of(values.camera_info_of(rolled, 3.5), 64, 64)
    np.testing.assert_allclose(again.world_to_camera, rolled.world_to_camera, atol=1e-9)
    assert again.fx == pytest.approx(rolled.fx)


@pytest.mark.parametrize(
    "change, line",
    [
        ({"cameraType": "orthographic"}, "expected a perspective camera"),
        ({"target": CAMERA["position"]}, "expected a position and a target that differ"),
        ({"position": {"x": math.nan}}, "expected finite numbers as position"),
        ({"fov": 180.0}, "expected a fov of 0 to 180 degrees"),
        ({"quaternion": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}}, "expected a quaternion that is not 0"),
    ],
)
def test_a_camera_that_is_none_is_one_line(values: Any, change: dict, line: str) -> None:
    with pytest.raises(ValueError, match=line):
        values.camera_of({**CAMERA, **change}, 64, 64)


# Edits


def painted(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(the picture with a green patch, its mask)."""
    picture, mask = image.clone(), torch.zeros(image.shape[:3])
    picture[0, 40:54, 38:56] = torch.tensor([0.1, 0.6, 0.2])
    mask[0, 38:56, 36:58] = 1
    return picture, mask


@pytest.mark.parametrize("gatekeeper", ["off", "normal"])
def test_an_edited_picture_goes_onto_the_splat(ops: Any, splat: SPLAT, gatekeeper: str) -> None:
    image, alpha = ops.render_view(splat, CAMERA, 96, 96)
    assert image.shape == (1, 96, 96, 3) and alpha.shape == (1, 96, 96)
    picture, mask = painted(image)
    edited, text = ops.lift_picture(splat, CAMERA, picture, gatekeeper=gatekeeper, mask=mask)
    receipt = Receipt.from_json(text)
    assert isinstance(edited, SPLAT) and edited.positions.shape[1] == 1500 + receipt.appended_rows
    untouched = np.setdiff1d(np.arange(1500), receipt.touched)
    for name in ("positions", "scales", "rotations", "opacities", "sh"):
        assert (getattr(edited, name)[0, untouched] == getattr(splat, name)[0, untouched]).all()
    after, _ = ops.render_view(edited, CAMERA, 96, 96)
    assert (after - picture)[0, 42:52, 40:54].abs().mean() < 0.05
    assert (after - image)[0, :30].abs().max() < 0.02 and len(untouched) > 1000


def test_changes_against_the_picture_of_another_renderer_are_carried_over(ops: Any, splat: SPLAT) -> None:
    image, _ = ops.render_view(splat, CAMERA, 96, 96)
    before = (image * 0.8 + 0.02).clamp(0, 1)  # its look is another one everywhere
    picture, _ = painted(before)
    edited, text = ops.lift_picture(splat, CAMERA, picture, gatekeeper="off", before=before)
    assert len(Receipt.from_json(text).touched) < 400
    after, _ = ops.render_view(edited, CAMERA, 96, 96)
    assert (after - image)[0, :30].abs().max() < 0.02
    assert (after - picture)[0, 42:52, 40:54].abs().mean() < 0.05


def test_a_regraded_picture_changes_all_sides(ops: Any, splat: SPLAT) -> None:
    image, _ = ops.render_view(splat, CAMERA, 64, 64)
    edited, text = ops.global_look(splat, image * torch.tensor([1.0, 0.7, 0.5]), CAMERA)
    assert json.loads(text)["mode"] == "global" and edited.positions.shape == splat.positions.shape
    behind = {**CAMERA, "position": {"x": 0.0, "y": 0.0, "z": -3.5}}
    before, after = (ops.render_view(s, behind, 64, 64)[0][0, 32, 32] for s in (splat, edited))
    assert after[2] < 0.7 * before[2]
    with pytest.raises(ValueError, match="expected image_2 and camera_info_2 together"):
        ops.global_look(splat, image, CAMERA, image_2=image)


def test_next_views_show_what_earlier_ones_have_not(ops: Any, splat: SPLAT, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage, "CANDIDATE_VIEWS", 20)  # enough for a ball, in half of the time
    info, image, mask, views, left = ops.next_view(splat, 96)
    assert image.shape == (1, 96, 96, 3) and mask.shape == (1, 96, 96) and left > 0.7 and len(views) == 1
    second, _, _, views, left = ops.next_view(splat, 96, views=views)
    assert left > 0.7 and len(views) == 2  # the other side
    eyes = [np.array([camera["position"][axis] for axis in "xyz"]) for camera in (info, second)]
    assert eyes[0] @ eyes[1] < 0
    around = [CAMERA, *(entry["camera_info"] for entry in views)]
    for x, y, z in (
        (3.3, 1, 0),
        (-3.3, 1, 0),
        (0, 1, -3.3),
        (0, 3.4, 0.5),
        (0, -3.4, 0.5),
        (2.4, 0, -2.4),
        (2.4, 0, 2.4),
    ):
        around.append({**CAMERA, "position": {"x": x, "y": y, "z": z}})
    everything = [{"camera_info": camera, "width": 96, "height": 96} for camera in around]
    *_, left = ops.next_view(splat, 96, views=everything)
    assert left < 0.4
    _, left_mask, share = ops.coverage(splat, views[:1], views[0]["camera_info"], 96, 96)
    assert share > 0.9 and left_mask.mean() < 0.04
    painted_mask, _, share = ops.coverage(splat, views[:1], views[1]["camera_info"], 96, 96)
    assert share < 0.6 and painted_mask.shape == (1, 96, 96)


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """ComfyUI's input and output folders, with vase.ply, and a ComfyUI whose core has no SPLAT."""
    module = types.ModuleType("folder_paths")
    module.get_input_directory = lambda: str(tmp_path / "input")  # type: ignore[attr-defined]
    module.get_output_directory = lambda: str(tmp_path / "output")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "folder_paths", module)
    for name, loaded in comfy_api(named=("Load3DCamera",)).items():
        monkeypatch.setitem(sys.modules, name, loaded)
    (tmp_path / "input").mkdir()
    saved(tmp_path / "input" / "vase.ply", replace(ball(900), antialiased=True))
    return tmp_path


def test_files_come_from_the_input_folder_and_go_to_the_output_folder(
    ops: Any, folders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, loaded in comfy_api().items():
        monkeypatch.setitem(sys.modules, name, loaded)
    saved(folders / "input" / "ball.ply", ball(300))
    (splat,) = ops.load_splat("ball.ply")
    assert isinstance(splat, SPLAT)
    (path,) = ops.save_splat(splat, "shelf/ball.spz", '{"a": 1}')
    assert Path(path) == folders / "output" / "shelf" / "ball.spz" and len(read(path)) == 300
    assert (folders / "output" / "shelf" / "ball.spz.receipt.json").read_text() == '{"a": 1}'
    for name in ("../ball.ply", "/etc/passwd", ""):
        with pytest.raises(ValueError, match="^file: expected a name inside "):
            ops.load_splat(name)


def test_what_is_saved_is_proved_against_the_file_that_was_loaded(ops: Any, folders: Path) -> None:
    (splat,) = ops.load_splat("vase.ply")
    assert type(splat).__name__ == "SplatBatch"
    boxes, texts = [(30, 40), (52, 60)], []
    for left, top in boxes:
        picture = ops.render_view(splat, CAMERA, 96, 96)[0]
        picture[0, top : top + 8, left : left + 12] = torch.tensor([0.1, 0.6, 0.2])
        splat, text = ops.lift_picture(splat, CAMERA, picture)
        texts.append(text)
    (path,) = ops.save_splat(splat, "painted.ply", texts[-1])
    receipt = Receipt.from_json((folders / "output" / "painted.ply.receipt.json").read_text())
    assert len(receipt.views) == 2 and len(receipt.touched) > len(Receipt.from_json(texts[0]).touched)
    assert verify(folders / "input" / "vase.ply", path, receipt).ok and read(path).antialiased
    assert ops.saved_files((path,)) == {"3d": [{"filename": "painted.ply", "subfolder": "", "type": "output"}]}


def test_a_splat_that_another_node_changed_is_saved_with_the_receipt_it_is_given(ops: Any, folders: Path) -> None:
    (splat,) = ops.load_splat("vase.ply")
    splat, text = ops.lift_picture(splat, CAMERA, painted(ops.render_view(splat, CAMERA, 96, 96)[0])[0])
    splat.positions = splat.positions + 1
    (path,) = ops.save_splat(splat, "moved.ply", text)
    assert (folders / "output" / "moved.ply.receipt.json").read_text() == text
    ops.save_splat(splat, "moved.ply")
    assert not (folders / "output" / "moved.ply.receipt.json").exists()  # it was of the file before
    assert (read(path).means[:900] > ball(900).means).all()


def test_a_file_that_changed_runs_again(pack: types.ModuleType, ops: Any, folders: Path) -> None:
    load = sys.modules["comfyui_pack"].NODE_CLASS_MAPPINGS["SplatPainterLoad"]
    newer = sys.modules["comfyui_pack.schemas"].v3_class(next(n for n in pack.NODES if n.id == "SplatPainterLoad"))
    before = load.IS_CHANGED(file="vase.ply")
    assert before == newer.fingerprint_inputs(file="vase.ply") == load.IS_CHANGED(file="vase.ply")
    saved(folders / "input" / "vase.ply", ball(800))
    assert load.IS_CHANGED(file="vase.ply") != before
    with pytest.raises(ValueError, match="^file: no 'gone.ply' in .*; put the splat there"):
        ops.load_splat("gone.ply")


def test_an_api_package_without_the_newer_schema_gets_the_old_one(monkeypatch: pytest.MonkeyPatch) -> None:
    modules = comfy_api()
    del modules["comfy_api.latest"].ComfyExtension  # type: ignore[attr-defined]
    for name, loaded in modules.items():
        monkeypatch.setitem(sys.modules, name, loaded)
    assert {"SplatPainterLift", "SplatPainterGrade"} <= set(load_pack("comfyui_pack_between").NODE_CLASS_MAPPINGS)


# Workflows


def test_the_workflows_are_those_of_the_nodes(pack: types.ModuleType) -> None:
    make = importlib.import_module("comfyui_pack.make_workflows")
    assert {path.name for path in (FOLDER / "workflows").iterdir()} == set(make.WORKFLOWS)
    for name, build in make.WORKFLOWS.items():
        text = (FOLDER / "workflows" / name).read_text(encoding="utf-8")
        assert json.loads(text) == json.loads(json.dumps(build().document())), f"{name}: run make_workflows again"


@pytest.mark.parametrize("path", sorted((FOLDER / "workflows").glob("*.json")), ids=lambda path: path.name)
def test_a_workflow_opens(pack: types.ModuleType, path: Path) -> None:
    """What ComfyUI's page checks: nodes that exist, links whose ends agree, required inputs, values for all widgets."""
    document = json.loads(path.read_text(encoding="utf-8"))
    nodes = {node["id"]: node for node in document["nodes"]}
    assert document["last_node_id"] == max(nodes) and document["last_link_id"] == len(document["links"])
    for link, source, output, target, slot, kind in document["links"]:
        one, other = nodes[source]["outputs"][output], nodes[target]["inputs"][slot]
        assert one["type"] == other["type"] == kind and link in one["links"] and other["link"] == link
    classes = sys.modules["comfyui_pack"].NODE_CLASS_MAPPINGS
    assert any(node["type"] == "SplatPainterSave" for node in nodes.values())
    for node in nodes.values():
        if node["type"] not in classes:
            assert node["type"] in ("ImageInvert", "PreviewImage", "LoadImage", "Note")
            continue
        inputs = classes[node["type"]].INPUT_TYPES()
        linked = {slot["name"] for slot in node["inputs"] if slot["link"] is not None}
        visible = {slot["name"] for slot in node["inputs"]}
        merged = {**inputs["required"], **inputs["optional"]}
        assert set(inputs["required"]) & visible <= linked
        widgets = [name for name in merged if name not in visible]
        assert len(node["widgets_values"]) == len(widgets)
        for name, value in zip(widgets, node["widgets_values"], strict=True):
            kind, options = merged[name]
            if isinstance(kind, list):
                assert value in kind
            elif "min" in options:
                assert options["min"] <= value <= options["max"]


# Operations


def test_each_operation_is_a_node_with_its_options(pack: types.ModuleType) -> None:
    nodes = {node.id: node for node in pack.NODES}
    grade = nodes["SplatPainterGrade"]
    assert [slot.id for slot in grade.inputs] == ["splat", *(field.name for field in fields(Grade))]
    slots = {slot.id: slot for slot in grade.inputs}
    assert slots["exposure"].type == "FLOAT" and slots["exposure"].tooltip == "Exposure in stops, of linear light."
    assert slots["match"].type == "IMAGE" and slots["where"].options == {"default": ""}
    remove = next(slot for slot in nodes["SplatPainterFill"].inputs if slot.id == "remove")
    assert remove.options == {"options": ["body", "selection"], "default": "body"}
    assert not {"source", "prompt", "seed"} & {slot.id for slot in nodes["SplatPainterFill"].inputs}
    assert {"SplatPainterDecal", "SplatPainterLight", "SplatPainterDelight", "SplatPainterPixelate"} <= set(nodes)


def test_operations_do_what_they_do_elsewhere(pack: types.ModuleType, values: Any, splat: SPLAT) -> None:
    nodes = {node.id: node for node in pack.NODES}
    defaults = {slot.id: slot.options["default"] for slot in nodes["SplatPainterGrade"].inputs if slot.options}
    inputs = {**defaults, "exposure": 0.5, "where": "y=..0 x=0.."}
    graded, receipt = nodes["SplatPainterGrade"].function(splat, **inputs)
    expected = Grade(exposure=0.5, where=["y=..0", "x=0.."]).apply(Asset(values.splats_of(splat)))  # pyright: ignore[reportArgumentType]
    assert expected.receipt is not None and json.loads(receipt)["touched_rows"] == len(expected.receipt.touched)
    assert (values.splats_of(graded).sh == expected.splats.sh).all()
    picture = torch.full((1, 8, 16, 3), 0.9)
    at = {"at": "48,48", "width": "20%", "view_width": 96, "view_height": 96}
    laid, receipt = nodes["SplatPainterDecal"].function(graded, picture=picture, camera=CAMERA, text="", **at)
    assert json.loads(receipt)["appended_rows"] > 0 and len(values.splats_of(laid)) > len(values.splats_of(splat))
    hidden, receipt = nodes["SplatPainterPixelate"].function(laid, where="z=..0", size="10%", merge=True)
    assert json.loads(receipt)["pixelation"]["merged"]
    with pytest.raises(ValueError, match="grade: expected sliders or one look"):
        nodes["SplatPainterGrade"].function(hidden, **defaults)
