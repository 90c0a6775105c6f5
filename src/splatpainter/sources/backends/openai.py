"""OpenAI's image editing as a source, or any service that speaks it: POST images/edits, multipart.

Its masks are the inverse of ours: *transparent* says "edit here". The mask guides the models that OpenAI serves and
binds none of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from splatpainter.image_files import encode_png, quantized
from splatpainter.sources.answer_pictures import image_png, read_answer, reference_png
from splatpainter.sources.backends.http import (
    Service,
    at,
    check_url,
    decode_base64,
    is_loopback,
    is_open,
    read_key,
    require_httpx,
    run,
)
from splatpainter.sources.picture_source import (
    CancelFlag,
    Capabilities,
    PictureAnswer,
    PictureRequest,
    Progress,
    SourceError,
)
from splatpainter.sources.source_options import SourceDescription, option
from splatpainter.system.quick_dataclass import dataclass

KEYS = ("OPENAI_API_KEY",)
OPENAI_URL = "https://api.openai.com/v1"
NO_KEY = "none"
"""Sent to other services where there is no key: many local ones look for none and refuse an empty header."""
MAX_REFERENCES = 15
"""Sixteen pictures with the one that is edited."""
CAPABILITIES = Capabilities(
    prompt=True, needs_prompt=True, mask=True, references=MAX_REFERENCES, max_side_px=4096, paid=True
)


@dataclass(frozen=True)
class OpenAIOptions:
    """Options of the source `openai`."""

    model: str = option("Model", "gpt-image-1.5")
    base_url: str = option("Address of the service, up to /v1", OPENAI_URL, environment=("OPENAI_BASE_URL",))
    size: str = option("Size of the answer as the model names them (auto, 1536x1024, ...); empty: not sent", "")
    quality: str = option("low, medium, high or auto; empty: not sent", "")
    input_fidelity: str = option("high: nearer to the picture; empty: not sent", "")
    response_format: str = option(
        "b64_json or url, for services that have a choice; empty: not sent", "", choices=("", "b64_json", "url")
    )
    timeout: float = option("Seconds for one picture, waiting included", 300.0, least=0.1)


DESCRIPTION = SourceDescription(
    name="openai",
    summary="OpenAI's images.edit, or any service that speaks it; paid",
    options=OpenAIOptions,
    capabilities=CAPABILITIES,
    keys=KEYS,
    modules=("httpx",),
    extra="openai",
)


def open_source(options: OpenAIOptions) -> OpenAISource:
    """Raises SourceError: options that cannot be, httpx missing."""
    return OpenAISource(options)


class OpenAISource:
    """One model of one service."""

    name = "openai"

    def __init__(self, options: OpenAIOptions) -> None:
        # Looked for before a view is rendered.
        require_httpx("openai")
        self.base_url = check_url("openai", "base_url", options.base_url)
        self.options = options
        # A service on this machine costs nothing, so dry runs count no paid calls.
        self.capabilities = replace(CAPABILITIES, paid=not is_loopback(self.base_url))

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """One call. Raises SourceError; SourceCancelled."""
        # Only OpenAI's own service surely wants a key; local ones mostly look for none.
        elsewhere = self.base_url != OPENAI_URL
        try:
            key = read_key("openai", KEYS)
        except SourceError:
            if not elsewhere:
                raise
            key = NO_KEY
        service = Service("openai", self.base_url, {"Authorization": f"Bearer {key}"}, progress, KEYS)
        fields, files = self._form(request)
        progress(0.0, f"asking {self.options.model}")

        async def work() -> tuple[bytes, Any]:
            data = await service.json("POST", "/images/edits", data=fields, files=files)
            entry = at(data, "data", 0)
            # The picture comes in the answer or at an address, as the service likes.
            if isinstance(text := at(entry, "b64_json"), str) and text:
                return decode_base64(text, "openai"), data
            if isinstance(url := at(entry, "url"), str) and url:
                progress(0.9, "fetching the picture")
                return await service.picture(url), data
            raise service.error(f"answered without a picture{_words(data)}")

        body, data = run(work, "openai", self.options.timeout, cancel)
        image, notes = read_answer(body, "openai")
        # What the service made of the prompt is what was painted; the receipt should say so.
        if isinstance(revised := at(data, "data", 0, "revised_prompt"), str) and revised:
            notes = (*notes, f"the service reworded the prompt: {revised[:300]}")
        if key != NO_KEY and is_open(self.base_url):
            notes = (*notes, f"the key went to {service.host} by http, which anybody on the way can read; use https")
        tokens = at(data, "usage", "total_tokens")
        return PictureAnswer(
            image,
            model=self.options.model,
            cost=f"{tokens:,} tokens" if isinstance(tokens, int) else "",
            notes=notes,
        )

    def _form(self, request: PictureRequest) -> tuple[dict[str, str], list[tuple[str, tuple[str, bytes, str]]]]:
        """(fields, files) of the form."""
        # Only what was set is sent: services refuse fields that they do not know.
        chosen = {
            "size": self.options.size,
            "quality": self.options.quality,
            "input_fidelity": self.options.input_fidelity,
            "response_format": self.options.response_format,
        }
        fields = {"model": self.options.model, "prompt": request.prompt, "n": "1"}
        fields |= {name: value for name, value in chosen.items() if value}
        # The name of the field changes with the number of pictures.
        several = "image[]" if request.references else "image"
        files = [(several, ("view.png", image_png(request), "image/png"))]
        for index, picture in enumerate(request.references):
            files.append((several, (f"reference_{index}.png", reference_png(picture), "image/png")))
        if request.mask is not None:
            files.append(("mask", ("mask.png", transparent_mask(request), "image/png")))
        return fields, files


def transparent_mask(request: PictureRequest) -> bytes:
    """RGBA PNG of the view's size: transparent where it may change, opaque where it may not."""
    # Its masks are the inverse of ours: transparent says "edit here".
    assert request.mask is not None
    pixels = np.concatenate([quantized(request.image), quantized(1 - request.mask)[..., None]], -1)
    return encode_png(pixels)


def _words(data: Any) -> str:
    text = at(data, "choices", 0, "message", "content") or at(data, "error", "message")
    return f": {' '.join(text.split())[:200]!r}" if isinstance(text, str) and text.strip() else ""
