"""A diffusion pipeline of a folder on this machine as a source, by Hugging Face's diffusers.

Nothing is fetched: the option `model` is a folder with a model_index.json, its weights are safetensors, and code that
came with it is not run. With a mask, or where the model is one that inpaints: AutoPipelineForInpainting; else
AutoPipelineForImage2Image. The picture is padded to a multiple of 16 pixels and the answer cut to it again, so that
pixels stay where they are.
"""

from __future__ import annotations

import importlib
import inspect
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.image_files import quantized
from splatpainter.pictures.picture_reader import Picture
from splatpainter.sources.answer_pictures import with_alpha
from splatpainter.sources.picture_source import (
    CancelFlag,
    Capabilities,
    PictureAnswer,
    PictureRequest,
    Progress,
    SourceCancelled,
    SourceError,
)
from splatpainter.sources.source_options import SourceDescription, option
from splatpainter.system.quick_dataclass import dataclass

INDEX = "model_index.json"
PICKLED_WEIGHTS = ("*.bin", "*.ckpt", "*.pt", "*.pth")
MULTIPLE_PX = 16
"""What the sides of pictures that pipelines take are multiples of: 8 for the autoencoder, 2 for patches of latents."""
MAX_INDEX_BYTES = 1 << 20
CAPABILITIES = Capabilities(prompt=True, mask=True, seed=True, max_seed=2**63 - 1, max_side_px=2048)


@dataclass(frozen=True)
class DiffusersOptions:
    """Options of the source `diffusers`."""

    model: Path = option("Folder of a pipeline, with model_index.json and safetensors")
    task: str = option("inpaint, img2img, or auto: inpaint with a mask", "auto", choices=("auto", "inpaint", "img2img"))
    steps: int = option("Steps of the sampler", 30, least=1, most=1000)
    strength: float = option("How far it may go from the picture, 0 to 1", 0.75, least=0, most=1)
    guidance: float = option("Guidance scale: how closely it follows the prompt", 7.0, least=0, most=100)
    negative: str = option("What the picture should not show", "")
    device: str = option("cpu, cuda or auto", "auto", choices=("auto", "cpu", "cuda"))
    precision: str = option(
        "float32, float16, bfloat16 or auto", "auto", choices=("auto", "float32", "float16", "bfloat16")
    )
    offload: bool = option("Keep parts of the model in main memory, for small GPUs", False)


DESCRIPTION = SourceDescription(
    name="diffusers",
    summary="a diffusion pipeline on this machine",
    options=DiffusersOptions,
    capabilities=CAPABILITIES,
    modules=("diffusers", "transformers"),
    extra="diffusers",
)


def open_source(options: DiffusersOptions) -> DiffusersSource:
    """Raises SourceError: no folder of a pipeline, weights that are pickles."""
    return DiffusersSource(options)


class DiffusersSource:
    """One pipeline, loaded when it is first used."""

    name = "diffusers"

    def __init__(self, options: DiffusersOptions) -> None:
        self.options = options
        self.pipeline_class = check_model_folder(options.model)
        self.capabilities = replace(CAPABILITIES, mask=options.task != "img2img")
        self._pipelines: dict[str, Any] = {}

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """One run of the pipeline. Looks at `cancel` after each step. Raises SourceError: a pipeline that cannot be
        loaded or fails, a picture that its safety checker took out; SourceCancelled."""
        import torch

        # A mask needs a pipeline that takes one; a model for inpainting is used as such, with all white.
        inpaints = request.mask is not None or self.options.task == "inpaint" or self._is_inpainting
        if self.options.task == "img2img":
            inpaints = False
        progress(0.0, f"loading {self.options.model.name}")
        pipeline = self._pipeline("inpaint" if inpaints else "img2img")
        # Loading may take long, and nothing in it looks at `cancel`.
        if cancel.is_set():
            raise SourceCancelled
        height, width = request.image.shape[:2]
        # Pipelines differ in what they accept; what one does not know is left out below.
        accepted = inspect.signature(pipeline.__call__).parameters

        def step_ended(_: Any, step: int, timestep: Any, values: dict[str, Any]) -> dict[str, Any]:
            if cancel.is_set():
                raise SourceCancelled
            steps = getattr(pipeline, "num_timesteps", None)  # fewer than were asked for, by the strength
            total = steps if isinstance(steps, int) and steps > 0 else self.options.steps
            progress(min((step + 1) / total, 1.0), f"step {step + 1} of {total}")
            return values

        # Sides in multiples that the model takes; the answer is cut to the view again.
        image = padded(quantized(request.image))
        values: dict[str, Any] = {
            "prompt": request.prompt,
            "image": _picture(image),
            "strength": self.options.strength,
            "num_inference_steps": self.options.steps,
            "guidance_scale": self.options.guidance,
            "height": image.shape[0],
            "width": image.shape[1],
            "callback_on_step_end": step_ended,
        }
        if inpaints:
            # An inpainting pipeline without a mask may change everything.
            mask = np.ones((height, width), np.float32) if request.mask is None else request.mask
            values["mask_image"] = _picture(padded(quantized(mask)))
        if self.options.negative:
            values["negative_prompt"] = self.options.negative
        # On the CPU, so that a seed gives the same start on every device.
        if request.seed is not None:
            values["generator"] = torch.Generator("cpu").manual_seed(request.seed)
        # Code of a model's: its errors are told as a source's, and the memory's with what helps.
        try:
            result = pipeline(**{name: value for name, value in values.items() if name in accepted})
        except SourceCancelled:
            raise
        except torch.cuda.OutOfMemoryError:
            raise SourceError(
                "source diffusers: out of memory on the GPU; set offload=yes, or send a smaller view"
            ) from None
        # What the checker puts in its place is no edit of the view.
        if any(getattr(result, "nsfw_content_detected", None) or ()):
            raise SourceError("source diffusers: its safety checker removed the picture; change the prompt")
        return PictureAnswer(
            cropped(_pixels(result), height, width),
            model=f"{self.options.model.name} ({type(pipeline).__name__})",
            seed=request.seed,
            notes=() if "strength" in accepted else ("this pipeline has no strength",),
        )

    @property
    def _is_inpainting(self) -> bool:
        return self.options.task == "auto" and "inpaint" in self.pipeline_class.lower()

    def _pipeline(self, task: str) -> Any:
        if task not in self._pipelines:
            self._pipelines.clear()  # two do not fit most memories
            self._pipelines[task] = self._loaded(task)
        return self._pipelines[task]

    def _loaded(self, task: str) -> Any:
        try:
            import torch

            diffusers: Any = importlib.import_module("diffusers")
        except ImportError:
            raise SourceError("source diffusers: needs diffusers; pip install 'splatpainter[diffusers]'") from None
        # The device and precision are chosen when the model is loaded, for torch takes long to import.
        chosen = self.options.device
        if chosen == "auto":
            chosen = "cuda" if torch.cuda.is_available() else "cpu"
        precision = self.options.precision
        # Half precision is for GPUs; CPUs are slow at it or cannot do it.
        if precision == "auto":
            precision = "float16" if chosen == "cuda" else "float32"
        _silence(diffusers)
        kind = diffusers.AutoPipelineForInpainting if task == "inpaint" else diffusers.AutoPipelineForImage2Image
        # Local files, safetensors and no code: a model's folder must not be able to run anything.
        try:
            pipeline = kind.from_pretrained(
                str(self.options.model),
                torch_dtype=getattr(torch, precision),
                use_safetensors=True,
                local_files_only=True,
                trust_remote_code=False,
            )
        except Exception as error:
            line = " ".join(str(error).split())[:300]
            raise SourceError(f"source diffusers: {self.options.model}: cannot be loaded ({line})") from None
        # Offloading moves the parts itself; moved before, all of them would be on the GPU at once.
        if self.options.offload and chosen == "cuda":
            pipeline.enable_model_cpu_offload()
        else:
            pipeline = pipeline.to(chosen)
        if hasattr(pipeline, "set_progress_bar_config"):
            pipeline.set_progress_bar_config(disable=True)
        return pipeline


def _silence(library: Any) -> None:
    """No bars of the library's on stderr: `progress` says how far it is."""
    quiet = getattr(getattr(getattr(library, "utils", None), "logging", None), "disable_progress_bar", None)
    if callable(quiet):
        quiet()


def check_model_folder(path: Path) -> str:
    """The pipeline's class by its index. Raises SourceError: no folder on this machine, no index, pickled weights."""
    # A name of the hub looks like a relative path; nothing is fetched for it.
    if not path.is_dir():
        raise SourceError(
            f"source diffusers: {path}: no such folder; expected a pipeline on this machine, nothing is fetched"
        )
    index = path / INDEX
    try:
        if not index.is_file() or index.stat().st_size > MAX_INDEX_BYTES:
            raise SourceError(f"source diffusers: {path}: expected a folder with {INDEX}")
        data = json.loads(index.read_text(encoding="utf-8"))
    except OSError as error:
        raise SourceError(f"source diffusers: {index}: cannot be read ({error.strerror})") from None
    except SourceError:
        raise
    except (ValueError, RecursionError):
        raise SourceError(f"source diffusers: {index}: is not JSON") from None
    # A list in its place names code that came with the model.
    name = data.get("_class_name") if isinstance(data, dict) else None
    if isinstance(name, list):
        raise SourceError(f"source diffusers: {path}: comes with code of its own for the pipeline, which is not run")
    if not isinstance(name, str):
        raise SourceError(f"source diffusers: {index}: expected _class_name, the pipeline's class")
    # Pickles can run any code when they are opened, so they are named and refused.
    if not any(path.rglob("*.safetensors")):
        pickled = next((str(file.relative_to(path)) for kind in PICKLED_WEIGHTS for file in path.rglob(kind)), "")
        given = f"; {pickled} is a pickle, which can run any code" if pickled else ""
        raise SourceError(f"source diffusers: {path}: expected weights as safetensors{given}")
    return name


def padded(pixels: np.ndarray) -> np.ndarray:
    """[H, W(, 3)] with its right and lower edge repeated up to a multiple of MULTIPLE_PX."""
    # At the right and lower edge, so that pixels stay where they are; repeated, so that no border appears.
    missing = [-side % MULTIPLE_PX for side in pixels.shape[:2]]
    return np.pad(pixels, [(0, missing[0]), (0, missing[1]), *[(0, 0)] * (pixels.ndim - 2)], "edge")


def cropped(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """[h, w, C] without the padding of a view of that size, also where the pipeline answered at another scale."""
    # In the answer's own scale: pipelines may answer larger than they were asked.
    full_height, full_width = height + -height % MULTIPLE_PX, width + -width % MULTIPLE_PX
    return image[
        : max(1, round(image.shape[0] * height / full_height)), : max(1, round(image.shape[1] * width / full_width))
    ]


def _pixels(result: Any) -> np.ndarray:
    """[h, w, 3 or 4] float32 of a pipeline's first picture."""
    # Pipelines answer with Pillow pictures; anything else is told here and not by numpy.
    pictures = getattr(result, "images", None)
    if not isinstance(pictures, list) or not pictures or not hasattr(pictures[0], "convert"):
        raise SourceError("source diffusers: the pipeline answered without a picture")
    picture = pictures[0]
    alpha = None
    if "A" in picture.getbands():
        alpha = np.asarray(picture.convert("RGBA").getchannel("A"), np.float32) / 255
    return with_alpha(Picture(np.asarray(picture.convert("RGB"), np.float32) / 255, alpha))


def _picture(pixels: np.ndarray) -> Any:
    from PIL import Image

    return Image.fromarray(pixels)
