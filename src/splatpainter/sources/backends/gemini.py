"""Google's Gemini image models ("Nano Banana") as a source, by the REST interface that google-genai speaks:
POST models/MODEL:generateContent with pictures as inline data, answered in the modality IMAGE.

They take no mask: it goes along as a further picture with a sentence that says what it is, and a note says so.
"""

from __future__ import annotations

import base64
import re
from typing import Any

from splatpainter.sources.answer_pictures import image_png, mask_png, read_answer, reference_png
from splatpainter.sources.backends.http import (
    Service,
    at,
    check_url,
    decode_base64,
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

KEYS = ("GEMINI_API_KEY", "GOOGLE_API_KEY")
MODEL_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,100}")
MASK_WORDS = (
    "The second picture is a mask of the first: change only what is white in it, and leave what is black exactly as it "
    "is. Do not draw the mask."
)
FRAME_WORDS = "Answer with the edited picture alone, with the same framing, size and viewpoint as the first picture."
REFERENCE_WORDS = "The last {count} pictures show what is meant; they are not to be edited."


@dataclass(frozen=True)
class GeminiOptions:
    """Options of the source `gemini`."""

    model: str = option("Model that answers with pictures", "gemini-2.5-flash-image")
    size: str = option("Size of the answer, where the model has a choice (1K, 2K, 4K)", "")
    base_url: str = option("Address of the service", "https://generativelanguage.googleapis.com/v1beta")
    timeout: float = option("Seconds for one picture, waiting included", 300.0, least=0.1)


def _capabilities(model: str) -> Capabilities:
    few = "2.5" in model  # sound with three pictures, says its documentation; later ones with fourteen
    return Capabilities(
        prompt=True,
        needs_prompt=True,
        mask=True,
        references=2 if few else 11,
        seed=True,
        max_seed=2**31 - 1,
        max_side_px=4096,
        paid=True,
    )


DESCRIPTION = SourceDescription(
    name="gemini",
    summary="Google's Gemini image models (Nano Banana); paid",
    options=GeminiOptions,
    capabilities=_capabilities("gemini-2.5-flash-image"),
    keys=KEYS,
    modules=("httpx",),
    extra="gemini",
)


def open_source(options: GeminiOptions) -> GeminiSource:
    """Raises SourceError: options that cannot be, httpx missing."""
    return GeminiSource(options)


class GeminiSource:
    """One model of the service."""

    name = "gemini"

    def __init__(self, options: GeminiOptions) -> None:
        # Looked for before a view is rendered, as the address and the model's name are.
        require_httpx("gemini")
        self.base_url = check_url("gemini", "base_url", options.base_url)
        self.model = options.model.removeprefix("models/")
        # The name becomes a part of the address, so it must be a name and nothing else.
        if not MODEL_NAME.fullmatch(self.model):
            raise SourceError(f"source gemini: option model: expected a name, got {options.model[:80]!r}")
        if options.size not in ("", "512", "1K", "2K", "4K"):
            raise SourceError(f"source gemini: option size: expected 1K, 2K or 4K, got {options.size[:20]!r}")
        self.options = options
        self.capabilities = _capabilities(self.model)

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """One call. Raises SourceError, also where the answer is text or was blocked; SourceCancelled."""
        # The key is read for each request and kept in no object (http.py).
        headers = {"x-goog-api-key": read_key("gemini", KEYS)}
        service = Service("gemini", self.base_url, headers, progress, KEYS)
        body = self._body(request)
        progress(0.0, f"asking {self.model}")

        async def work() -> Any:
            return await service.json("POST", f"/models/{self.model}:generateContent", json=body)

        data = run(work, "gemini", self.options.timeout, cancel)
        image, notes = read_answer(picture_of(data), "gemini")
        # The note comes first: it says how far the answer can be relied on.
        if request.mask is not None:
            notes = (
                "takes no mask: it was sent as a second picture, and nothing holds the model to it",
                *notes,
            )
        # What it cost and which version answered stand in the receipt, where the service says it.
        tokens = at(data, "usageMetadata", "totalTokenCount")
        version = at(data, "modelVersion")
        return PictureAnswer(
            image,
            model=version if isinstance(version, str) else self.model,
            seed=request.seed,
            cost=f"{tokens:,} tokens" if isinstance(tokens, int) else "",
            notes=notes,
        )

    def _body(self, request: PictureRequest) -> dict[str, Any]:
        # The view comes first and the mask second: the sentences call them so.
        words = [request.prompt, FRAME_WORDS]
        pictures = [image_png(request)]
        if request.mask is not None:
            words.insert(1, MASK_WORDS)
            pictures.append(mask_png(request))
        # References come last, and their sentence counts them: the model has no other way to tell pictures apart.
        if request.references:
            words.append(REFERENCE_WORDS.format(count=len(request.references)))
            pictures += [reference_png(picture) for picture in request.references]
        # Text is allowed beside the picture: it says why where none came.
        config: dict[str, Any] = {"responseModalities": ["TEXT", "IMAGE"]}
        if request.seed is not None:
            config["seed"] = request.seed
        if self.options.size:
            config["imageConfig"] = {"imageSize": self.options.size}
        inline = [{"inlineData": {"mimeType": "image/png", "data": base64.b64encode(png).decode()}} for png in pictures]
        return {
            "contents": [{"role": "user", "parts": [{"text": "\n\n".join(words)}, *inline]}],
            "generationConfig": config,
        }


def picture_of(data: Any) -> bytes:
    """The last picture of an answer (models that think draw drafts first). Raises SourceError: blocked, text, none."""
    # From the refusal to the answer: a blocked prompt has no candidates at all.
    if finish_reason := at(data, "promptFeedback", "blockReason"):
        raise SourceError(f"source gemini: refused the prompt or the picture ({finish_reason}); change the prompt")
    parts = at(data, "candidates", 0, "content", "parts")
    parts = [part for part in parts if isinstance(part, dict)] if isinstance(parts, list) else []
    # Thoughts are drafts; the picture behind them is the answer.
    inline = [part.get("inlineData") or part.get("inline_data") for part in parts if not part.get("thought")]
    drawn = [part["data"] for part in inline if isinstance(part, dict) and "data" in part]
    if drawn:
        return decode_base64(drawn[-1], "gemini")
    finish_reason, finish_message = (
        at(data, "candidates", 0, "finishReason"),
        at(data, "candidates", 0, "finishMessage"),
    )
    # An end for another reason than being done explains the missing picture.
    if isinstance(finish_reason, str) and finish_reason not in ("STOP", "FINISH_REASON_UNSPECIFIED"):
        explanation = f": {finish_message}" if isinstance(finish_message, str) and finish_message else ""
        raise SourceError(f"source gemini: gave no picture ({finish_reason}{explanation}); change the prompt")
    # Words in place of a picture are shown: mostly they say why.
    text = " ".join(part["text"] for part in parts if isinstance(part.get("text"), str))
    if text.strip():
        raise SourceError(f"source gemini: answered with text instead of a picture: {' '.join(text.split())[:200]!r}")
    raise SourceError("source gemini: answered without a picture")
