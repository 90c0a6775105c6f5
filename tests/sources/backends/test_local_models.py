"""The sources `upscale` and `diffusers`, with stand-ins of the libraries' published interfaces: no weights are needed,
and the libraries are large."""

from __future__ import annotations

import importlib.machinery
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from splatpainter.sources.backends.diffusers import cropped, padded
from splatpainter.sources.backends.upscale import enlarge, tile_starts
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest, SourceCancelled, SourceError
from splatpainter.sources.registry import open_source
from tests.support.picture_requests import HEIGHT, WIDTH, Progressed, request


def edit(name: str, query: PictureRequest, progress: Progressed | None = None, **options: object) -> PictureAnswer:
    progress = progress or Progressed()
    source = open_source(name, {key: str(value) for key, value in options.items()})
    return source.edit(query, progress, progress.cancel)


def stand_in(monkeypatch: pytest.MonkeyPatch, name: str, **contents: Any) -> None:
    module = ModuleType(name)
    module.__spec__ = importlib.machinery.ModuleSpec(name, None)
    module.__dict__.update(contents)
    monkeypatch.setitem(sys.modules, name, module)


# ---- upscale without a model


@pytest.mark.parametrize("scale", [2, 4])
def test_enlarged_without_a_model(scale: int) -> None:
    answer = edit("upscale", request(scale=scale))
    assert answer.image.shape == (HEIGHT * scale, WIDTH * scale, 3)
    pooled = answer.image.reshape(HEIGHT, scale, WIDTH, scale, 3).mean((1, 3))
    assert np.abs(pooled - request().image).max() < 0.02


def test_sharpening_is_sharper_and_has_no_halo() -> None:
    edge = np.repeat((np.arange(16) >= 8).astype(np.float32)[None, :, None], 3, 2) * 0.5 + 0.25
    edge = np.repeat(edge, 8, 0)
    soft, sharp = enlarge(edge, 4, 0.0), enlarge(edge, 4, 1.0)
    assert np.abs(np.diff(sharp, axis=1)).max() > np.abs(np.diff(soft, axis=1)).max()
    assert sharp.min() >= 0.25 - 1e-6 and sharp.max() <= 0.75 + 1e-6
    assert soft.min() < 0.25  # Lanczos itself rings
    np.testing.assert_allclose(enlarge(np.full((8, 8, 3), 0.3, np.float32), 2, 1.0), 0.3, atol=1e-5)


def test_what_upscale_refuses(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="does not take an enlargement of 1; it takes enlargements of 2, 4"):
        edit("upscale", request())
    with pytest.raises(SourceError, match="more than 67 megapixels"):
        edit("upscale", replace(request(scale=4), image=np.zeros((3000, 3000, 3), np.float32)))
    with pytest.raises(SourceError, match="no such file"):
        open_source("upscale", {"model": str(tmp_path / "x.safetensors")})
    for name, line in (("x.pth", "is a pickle, which can run any code"), ("x.zip", "expected a model .*, got .zip")):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(SourceError, match=line):
            open_source("upscale", {"model": str(tmp_path / name)})
    assert open_source("upscale", {"model": str(tmp_path / "x.pth"), "pickles": "yes"}).capabilities.scales == (1, 2, 4)


# ---- upscale with a model


class Descriptor:
    """As spandrel's ImageModelDescriptor: [1, 3, h, w] of 0..1 in and out, here by repeating pixels."""

    def __init__(self, scale: int, channels: int = 3) -> None:
        self.scale, self.input_channels, self.output_channels = scale, channels, 3
        self.device, self.dtype = torch.device("cpu"), torch.float32
        self.architecture = SimpleNamespace(name="ESRGAN")
        self.shapes: list[tuple[int, ...]] = []

    def eval(self) -> Descriptor:
        return self

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        self.shapes.append(tuple(image.shape))
        return image.repeat_interleave(self.scale, 2).repeat_interleave(self.scale, 3)


@pytest.fixture
def model_file(tmp_path: Path) -> Path:
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"weights")
    return path


def spandrel(monkeypatch: pytest.MonkeyPatch, descriptor: object) -> list[str]:
    loaded: list[str] = []

    class ModelLoader:
        def __init__(self, device: torch.device | None = None) -> None:
            assert device is None or isinstance(device, torch.device)

        def load_from_file(self, path: str) -> object:
            loaded.append(path)
            if isinstance(descriptor, Exception):
                raise descriptor
            return descriptor

    stand_in(monkeypatch, "spandrel", ModelLoader=ModelLoader, ImageModelDescriptor=Descriptor)
    return loaded


@pytest.mark.parametrize(("scale", "model_scale"), [(1, 1), (2, 2), (4, 4), (4, 2), (2, 4), (2, 1)])
def test_a_model_by_tiles(model_file: Path, monkeypatch: pytest.MonkeyPatch, scale: int, model_scale: int) -> None:
    descriptor = Descriptor(model_scale)
    loaded = spandrel(monkeypatch, descriptor)
    random = np.random.default_rng(0).random((70, 100, 3)).astype(np.float32)
    query = replace(request(scale=scale), image=random, alpha=np.ones((70, 100), np.float32))
    progress = Progressed()
    answer = edit("upscale", query, progress, model=model_file, tile=32, overlap=4)
    assert answer.image.shape == (70 * scale, 100 * scale, 3) and answer.model == "model.safetensors (ESRGAN)"
    if scale >= model_scale and model_scale > 1:
        np.testing.assert_allclose(answer.image, random.repeat(scale, 0).repeat(scale, 1), atol=1e-5)
    assert loaded == [str(model_file)] and max(max(shape[2:]) for shape in descriptor.shapes) <= 40
    assert any(words == "tile 2 of 12" for _, words in progress.reports)


def test_tiles_cover_everything() -> None:
    assert tile_starts(100, 32) == [0, 32, 64, 96] and tile_starts(32, 32) == [0] and tile_starts(5, 32) == [0]


@pytest.mark.parametrize(
    ("descriptor", "line"),
    [
        (RuntimeError("unknown\narchitecture"), r"cannot be loaded \(RuntimeError: unknown architecture\)"),
        (object(), "expected a model that enlarges or restores pictures"),
        (Descriptor(2, 1), "expected a model of RGB pictures, got 1 to 3 channels"),
    ],
)
def test_models_that_are_refused(
    model_file: Path, monkeypatch: pytest.MonkeyPatch, descriptor: object, line: str
) -> None:
    spandrel(monkeypatch, descriptor)
    with pytest.raises(SourceError, match=line):
        edit("upscale", request(scale=2), model=model_file)


def test_a_model_whose_answer_is_wrong(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptor = Descriptor(2)
    spandrel(monkeypatch, descriptor)
    monkeypatch.setattr(Descriptor, "__call__", lambda self, image: image * float("nan"))
    with pytest.raises(SourceError, match="the model answered"):
        edit("upscale", request(scale=2), model=model_file)


def test_cancelled_between_tiles(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptor = Descriptor(2)
    spandrel(monkeypatch, descriptor)
    wide = replace(request(scale=2), image=np.zeros((32, 320, 3), np.float32), alpha=np.ones((32, 320), np.float32))
    with pytest.raises(SourceCancelled):
        edit("upscale", wide, Progressed("tile 3"), model=model_file, tile=32)
    assert len(descriptor.shapes) == 3


def test_models_need_spandrel(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "spandrel", None)
    with pytest.raises(SourceError, match=r"models need spandrel; pip install 'splatpainter\[upscale\]'"):
        edit("upscale", request(scale=2), model=model_file)


# ---- diffusers


class Pipeline:
    """As a pipeline of diffusers: paints where the mask is white."""

    calls: list[dict[str, Any]] = []
    flagged = False
    num_timesteps = 0

    def to(self, device: str) -> Pipeline:
        assert device == "cpu"
        return self

    def set_progress_bar_config(self, disable: bool) -> None:
        assert disable

    def paint(self, values: dict[str, Any]) -> SimpleNamespace:
        self.calls.append(values)
        for step in range(self.num_timesteps or values["num_inference_steps"]):
            assert values["callback_on_step_end"](self, step, 1000 - step, {"latents": 0}) == {"latents": 0}
        pixels = np.asarray(values["image"]).copy()
        mask = values.get("mask_image")
        pixels[np.asarray(mask) > 127 if mask is not None else slice(None)] = (0, 255, 0)
        return SimpleNamespace(images=[Image.fromarray(pixels)], nsfw_content_detected=[self.flagged])


class InpaintPipeline(Pipeline):
    def __call__(
        self,
        prompt: str,
        image: Image.Image,
        mask_image: Image.Image,
        height: int,
        width: int,
        num_inference_steps: int,
        callback_on_step_end: Any,
        strength: float = 1.0,
        guidance_scale: float = 7.5,
        negative_prompt: str = "",
        generator: torch.Generator | None = None,
    ) -> SimpleNamespace:
        return self.paint({name: value for name, value in locals().items() if name != "self"})


class Image2ImagePipeline(Pipeline):
    def __call__(
        self, prompt: str, image: Image.Image, num_inference_steps: int, callback_on_step_end: Any
    ) -> SimpleNamespace:
        return self.paint({name: value for name, value in locals().items() if name != "self"})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pipeline on this machine, and a stand-in of the library that opens it."""
    (tmp_path / "unet").mkdir()
    (tmp_path / "unet" / "model.safetensors").write_bytes(b"weights")
    (tmp_path / "model_index.json").write_text(json.dumps({"_class_name": "StableDiffusionPipeline"}), "utf-8")
    monkeypatch.setattr(Pipeline, "calls", [])

    def auto(kind: type[Pipeline]) -> Any:
        def from_pretrained(path: str, **options: Any) -> Pipeline:
            assert options == {
                "torch_dtype": torch.float32,
                "use_safetensors": True,
                "local_files_only": True,
                "trust_remote_code": False,
            }
            assert path == str(tmp_path)
            return kind()

        return SimpleNamespace(from_pretrained=from_pretrained)

    automatic = {
        "AutoPipelineForInpainting": auto(InpaintPipeline),
        "AutoPipelineForImage2Image": auto(Image2ImagePipeline),
    }
    stand_in(monkeypatch, "diffusers", **automatic)
    stand_in(monkeypatch, "transformers")
    return tmp_path


def test_a_pipeline_with_a_mask(folder: Path) -> None:
    progress = Progressed()
    options = {"steps": 3, "strength": 0.5, "negative": "blur", "device": "cpu"}
    answer = edit("diffusers", request("moss", True, 2**62 + 3), progress, model=folder, **options)
    half = WIDTH // 2
    assert answer.image.shape == (HEIGHT, WIDTH, 3) and (answer.image[:, half:] == (0, 1, 0)).all()
    assert np.abs(answer.image[:, :half] - request().image[:, :half]).max() <= 0.5 / 255 + 1e-6
    assert answer.model == f"{folder.name} (InpaintPipeline)" and answer.seed == 2**62 + 3
    assert progress.reports[-1] == (1.0, "step 3 of 3")
    (call,) = Pipeline.calls
    assert (call["prompt"], call["strength"], call["guidance_scale"]) == ("moss", 0.5, 7.0)
    assert call["negative_prompt"] == "blur" and call["generator"].initial_seed() == 2**62 + 3
    assert (call["height"], call["width"]) == call["mask_image"].size[::-1] == call["image"].size[::-1] == (32, 32)


def test_a_pipeline_without_a_mask(folder: Path) -> None:
    answer = edit("diffusers", request("moss"), model=folder, steps=1, device="cpu")
    assert (answer.image == (0, 1, 0)).all() and answer.notes == ("this pipeline has no strength",)
    (folder / "model_index.json").write_text(json.dumps({"_class_name": "StableDiffusionInpaintPipeline"}), "utf-8")
    edit("diffusers", request("moss"), model=folder, steps=1, device="cpu")
    assert (np.asarray(Pipeline.calls[1]["mask_image"]) == 255).all()
    with pytest.raises(SourceError, match="does not take a mask"):
        edit("diffusers", request("moss", True), model=folder, task="img2img")


def test_a_pipeline_that_is_cancelled_or_flags(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceCancelled):
        edit("diffusers", request("moss"), Progressed("step 2"), model=folder, device="cpu")
    monkeypatch.setattr(Pipeline, "num_timesteps", 2)
    progress = Progressed()
    edit("diffusers", request("moss"), progress, model=folder, steps=4, device="cpu")
    assert progress.reports[-1] == (1.0, "step 2 of 2")
    monkeypatch.setattr(Pipeline, "flagged", True)
    with pytest.raises(SourceError, match="its safety checker removed the picture"):
        edit("diffusers", request("moss"), model=folder, steps=1, device="cpu")


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("model_index.json", "{", "is not JSON"),
        ("model_index.json", "[]", "expected _class_name"),
        (
            "model_index.json",
            '{"_class_name": ["code", "Pipeline"]}',
            "comes with code of its own for the pipeline, which is not",
        ),
        ("model_index.json", None, "expected a folder with model_index.json"),
        ("unet/model.safetensors", None, "expected weights as safetensors$"),
        ("unet/model.bin", "", "unet/model.bin is a pickle, which can run any code"),
    ],
)
def test_folders_that_are_refused(folder: Path, name: str, content: str | None, line: str) -> None:
    if name.startswith("unet"):
        (folder / "unet" / "model.safetensors").unlink()
    if content is None:
        (folder / name).unlink(missing_ok=True)
    else:
        (folder / name).write_text(content, "utf-8")
    with pytest.raises(SourceError, match=line):
        open_source("diffusers", {"model": str(folder)})


def test_nothing_is_fetched(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceError, match="no such folder; expected a pipeline on this machine, nothing is fetched"):
        open_source("diffusers", {"model": "stabilityai/sdxl"})
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(SourceError, match=r"diffusers not installed: pip install 'splatpainter\[diffusers\]'"):
        open_source("diffusers", {"model": str(folder)})


def test_padding_is_taken_away_again() -> None:
    image = np.random.default_rng(0).random((33, 40, 3)).astype(np.float32)
    assert padded(image).shape == (48, 48, 3) and padded(image[..., 0]).shape == (48, 48)
    np.testing.assert_array_equal(cropped(padded(image), 33, 40), image)
    assert cropped(padded(image).repeat(2, 0).repeat(2, 1), 33, 40).shape == (66, 80, 3)
