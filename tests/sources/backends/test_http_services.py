"""The sources `gemini` and `openai` against a server that speaks their interfaces: what is sent, what comes back, how
it fails, and that no key gets anywhere but into the header."""

from __future__ import annotations

import _thread
import base64
import logging
import threading
import traceback
from collections.abc import Iterator
from email.utils import formatdate

import numpy as np
import pytest

from splatpainter.pictures.foreign_pictures import READ_KINDS
from splatpainter.sources.backends import http
from splatpainter.sources.backends.http import retry_seconds
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest, SourceCancelled, SourceError
from splatpainter.sources.registry import open_source
from tests.support.fake_services import (
    Call,
    FakeService,
    Reply,
    animated,
    bomb,
    inks,
    pixels,
    png,
    serving,
    text64,
)
from tests.support.picture_requests import HEIGHT, WIDTH, Progressed, request

KEY = "AIza-0123456789-the-key"
HTML = b"<!DOCTYPE html><html><head><title>Log in &amp; pay</title></head><body>please</body></html>"


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeService]:
    """A server; the keys are set, waits are short."""
    for name in ("GEMINI_API_KEY", "OPENAI_API_KEY"):
        monkeypatch.setenv(name, KEY)
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    monkeypatch.setattr(http, "FIRST_WAIT_SECONDS", 0.01)
    with serving() as server:
        yield server


def drawn(data: bytes, **more: object) -> Reply:
    """An answer of Gemini with a picture."""
    parts = [{"text": "Here it is"}, {"inlineData": {"mimeType": "image/png", "data": text64(data)}}]
    return Reply({"candidates": [{"content": {"parts": parts}, "finishReason": "STOP"}], **more})


def gemini(service: FakeService, query: PictureRequest | None = None, **options: str) -> PictureAnswer:
    progress = options.pop("progress", None) or Progressed()
    source = open_source("gemini", {"base_url": f"{service.url}/v1beta", **options})
    return source.edit(query or request("rust"), progress, progress.cancel)  # type: ignore[union-attr]


def openai(service: FakeService, query: PictureRequest | None = None, **options: str) -> PictureAnswer:
    progress = Progressed()
    source = open_source("openai", {"base_url": f"{service.url}/v1", **options})
    return source.edit(query or request("rust"), progress, progress.cancel)


def test_gemini_there_and_back(service: FakeService) -> None:
    usage = {"usageMetadata": {"totalTokenCount": 1548}, "modelVersion": "gemini-2.5-flash-image-001"}
    service.replies = [drawn(png(64, 48), **usage)]
    answer = gemini(service, request("make it rusty", True, 2**31 - 1, 2), size="1K")
    assert answer.image.shape == (48, 64, 3) and (answer.image == (1, 0, 0)).all()
    assert (answer.model, answer.cost) == ("gemini-2.5-flash-image-001", "1,548 tokens")
    assert "takes no mask: it was sent as a second picture" in answer.notes[0]
    (call,) = service.calls
    assert (call.method, call.path) == ("POST", "/v1beta/models/gemini-2.5-flash-image:generateContent")
    assert call.headers["x-goog-api-key"] == KEY and KEY not in call.path and KEY.encode() not in call.body
    body = call.json()
    assert body["generationConfig"] == {
        "responseModalities": ["TEXT", "IMAGE"],
        "seed": 2**31 - 1,
        "imageConfig": {"imageSize": "1K"},
    }
    (content,) = body["contents"]
    text, *pictures = content["parts"]
    assert text["text"].startswith("make it rusty") and "mask" in text["text"] and "last 2 pictures" in text["text"]
    shapes = [pixels(base64.b64decode(part["inlineData"]["data"])).shape for part in pictures]
    assert shapes == [(HEIGHT, WIDTH, 3), (HEIGHT, WIDTH), (8, 8, 3), (8, 8, 3)]


@pytest.mark.parametrize(
    ("reply", "line"),
    [
        ({"promptFeedback": {"blockReason": "SAFETY"}}, "refused the prompt or the picture (SAFETY)"),
        ({"candidates": [{"finishReason": "IMAGE_SAFETY"}]}, "gave no picture (IMAGE_SAFETY)"),
        (
            {"candidates": [{"content": {"parts": [{"text": "I cannot\ndo this"}]}}]},
            "with text instead of a picture",
        ),
        ({}, "answered without a picture"),
        ([], "answered without a picture"),
        ({"candidates": [{"content": {"parts": [{"inlineData": {"data": "%%"}}]}}]}, "a picture that is not base64"),
        (HTML, "a web page (Log in & pay) in place of JSON"),
        (b"{not json", "expected JSON, got '{not json'"),
        (b"[" * 100_000, "expected JSON"),
    ],
)
def test_answers_of_gemini_that_are_no_picture(service: FakeService, reply: object, line: str) -> None:
    service.replies = [Reply(reply)]
    with pytest.raises(SourceError) as error:
        gemini(service)
    assert str(error.value).startswith("source gemini: ") and line in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("data", "line"),
    [
        (animated(), "expected a still picture, got PNG with 2 frames"),
        (inks(), "expected RGB colours, got CMYK"),
        (bomb(), "at most 67 megapixels"),
        (
            b"GIF89a",
            f"expected a {READ_KINDS} picture, got a GIF; export it as PNG",
        ),
        (png()[:60], "damaged|cannot be read"),
    ],
)
def test_pictures_that_are_refused(service: FakeService, data: bytes, line: str) -> None:
    service.replies = [drawn(data)]
    with pytest.raises(SourceError, match=f"^source gemini: its picture: .*({line})"):
        gemini(service)


def test_openai_there_and_back(service: FakeService) -> None:
    entry = {"b64_json": text64(png(color=(0, 255, 0, 128))), "revised_prompt": "rusty iron"}
    service.replies = [Reply({"data": [entry], "usage": {"total_tokens": 99}})]
    answer = openai(service, request("rust", True, references=1), size="auto", model="iron-1")
    assert answer.image.shape == (HEIGHT, WIDTH, 4) and answer.image[0, 0, 3] == pytest.approx(128 / 255)
    assert (answer.model, answer.cost) == ("iron-1", "99 tokens") and "rusty iron" in answer.notes[0]
    (call,) = service.calls
    assert (call.method, call.path) == ("POST", "/v1/images/edits")
    assert call.headers["authorization"] == f"Bearer {KEY}" and KEY.encode() not in call.body
    parts = call.form()
    fields = {name: content.decode() for name, file, content in parts if file is None}
    assert fields == {"model": "iron-1", "prompt": "rust", "n": "1", "size": "auto"}
    files = {name: content for name, file, content in parts if file}
    assert [name for name, file, _ in parts if file] == ["image[]", "image[]", "mask"]
    alpha = pixels(files["mask"])[..., 3]
    assert (alpha[:, : WIDTH // 2] == 255).all() and (alpha[:, WIDTH // 2 :] == 0).all()


def test_openai_by_address(service: FakeService) -> None:
    service.replies = [Reply({"data": [{"url": "/files/1.png"}]}), Reply(png())]
    assert openai(service, response_format="url").image.shape == (HEIGHT, WIDTH, 3)
    assert [call.path for call in service.calls] == ["/v1/images/edits", "/files/1.png"]
    service.replies = [Reply({"data": [{"url": f"data:image/png;base64,{text64(png())}"}]})]
    assert openai(service).image.shape == (HEIGHT, WIDTH, 3)
    for url, line in (
        ("http://example.com/x.png", "neither https nor its own"),
        ("ftp://example.com/x.png", "neither https nor its own"),
        ("file:///etc/passwd", "neither https nor its own"),
        ("data:image/png,abc", "not base64"),
    ):
        service.replies = [Reply({"data": [{"url": url}]})]
        with pytest.raises(SourceError, match=line):
            openai(service)
    service.replies = [Reply({"data": [{"url": "/files/1.png"}]}), Reply(HTML, headers={"Content-Type": "text/html"})]
    with pytest.raises(SourceError, match="a web page .* in place of a picture"):
        openai(service)
    service.replies = [Reply({"choices": [{"message": {"content": "I cannot"}}]})]
    with pytest.raises(SourceError, match="answered without a picture: 'I cannot'"):
        openai(service)


def test_other_services_need_no_key(service: FakeService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENAI_API_KEY")
    service.replies = [Reply({"data": [{"b64_json": text64(png())}]})]
    assert not openai(service).notes
    assert service.calls[0].headers["authorization"] == "Bearer none"
    assert open_source("openai").capabilities.paid
    assert not open_source("openai", {"base_url": f"{service.url}/v1"}).capabilities.paid
    progress = Progressed()
    with pytest.raises(SourceError, match="needs a key in the environment: set OPENAI_API_KEY"):
        open_source("openai").edit(request("rust"), progress, progress.cancel)
    monkeypatch.setenv("OPENAI_BASE_URL", f"{service.url}/v1")
    assert open_source("openai").edit(request("rust"), progress, progress.cancel).image.shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    ("status", "body", "line"),
    [
        (
            401,
            {"error": {"message": f"Incorrect API key provided: {KEY}"}},
            "refused the key in GEMINI_API_KEY (401: Inc",
        ),
        (403, HTML, "refused the key in GEMINI_API_KEY (403: a web page (Log in & pay))"),
        (
            400,
            [{"error": {"message": "API key expired. Please renew"}}],
            "refused the key in GEMINI_API_KEY (400: API key",
        ),
        (400, {"error": "bad size"}, "refused the request (400: bad size)"),
        (404, {"error": {"message": "no model x"}}, "refused the request (404: no model x)"),
        (500, b"oh\nno", "refused the request (500: oh no)"),
        (302, b"", "redirects to evil.example (302); give the address that answers"),
    ],
)
def test_refusals(service: FakeService, status: int, body: object, line: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    service.replies = [Reply(body, status, {"Location": "https://evil.example/login"})]
    with pytest.raises(SourceError) as error:
        gemini(service)
    assert line in str(error.value) and "\n" not in str(error.value)
    assert len(service.calls) == 1
    messages = "".join(traceback.format_exception(error.value)) + caplog.text
    assert KEY not in messages


def test_no_key_is_held_by_a_source(service: FakeService, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    service.replies = [drawn(png(), modelVersion=KEY)]
    source = open_source("gemini", {"base_url": service.url})
    progress = Progressed()
    answer = source.edit(request("rust"), progress, progress.cancel)
    inner = source._source
    assert KEY not in repr(answer) + repr(vars(inner)) + repr(source) + caplog.text + repr(progress.reports)


def test_busy_services_are_asked_again(service: FakeService) -> None:
    busy = Reply({"error": "slow down"}, 429)
    service.replies = [
        busy,
        Reply(b"", 503, {"Retry-After": "0"}),
        Reply(b"", 429, {"Retry-After": "soon"}),
        drawn(png()),
    ]
    progress = Progressed()
    gemini(service, progress=progress)  # type: ignore[arg-type]
    assert len(service.calls) == 4
    assert any("too many requests; again in" in words for _, words in progress.reports)
    service.calls.clear()
    service.replies = [busy]
    with pytest.raises(SourceError, match=r"too many requests \(429: slow down\), 5 times; try again later"):
        gemini(service)
    assert len(service.calls) == 5
    service.replies = [Reply({"error": "quota"}, 429, {"Retry-After": "3600"})]
    with pytest.raises(SourceError, match=r"\(429: quota\); it asks to try again in 3,600 seconds"):
        gemini(service)


def test_retry_after() -> None:
    assert retry_seconds(None) is None and retry_seconds("soon") is None and retry_seconds("-1") is None
    assert retry_seconds(" 7 ") == 7
    assert retry_seconds("Wed, 21 Oct 2015 07:28:00 GMT") == 0
    later = retry_seconds(formatdate(4_000_000_000, usegmt=True))
    assert later is not None and later > 1e6


def test_slow_services(service: FakeService) -> None:
    never = threading.Event()
    service.replies = [Reply(b"{}", wait=never)]
    with pytest.raises(SourceError, match="gave no answer within 0.3 seconds"):
        gemini(service, timeout="0.3")
    progress = Progressed("asking")
    with pytest.raises(SourceCancelled):
        gemini(service, progress=progress)  # type: ignore[arg-type]
    progress = Progressed("again in")
    service.replies = [Reply(b"", 429, {"Retry-After": "30"})]
    with pytest.raises(SourceCancelled):
        gemini(service, progress=progress)  # type: ignore[arg-type]


def test_ctrl_c(service: FakeService) -> None:
    def reply(call: Call) -> Reply:
        _thread.interrupt_main()
        return Reply(b"{}", wait=threading.Event())

    service.handler = reply
    with pytest.raises(KeyboardInterrupt):
        gemini(service)
    assert not [thread for thread in threading.enumerate() if thread.name == "source gemini" and thread.is_alive()]


def test_bodies_that_are_too_long(service: FakeService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "MAX_JSON_BYTES", 1 << 20)
    service.replies = [Reply(b"", endless=True)]
    with pytest.raises(SourceError, match="answers with more than 1 MiB"):
        gemini(service)
    service.replies = [Reply(bytes(3 << 20))]
    with pytest.raises(SourceError, match="answers with 3 MiB; expected at most 1 MiB"):
        gemini(service)
    service.replies = [Reply(b"", headers={"Content-Encoding": "gzip"})]
    with pytest.raises(SourceError, match="in the encoding gzip, which was not accepted"):
        gemini(service)


def test_nobody_there(service: FakeService) -> None:
    with serving() as closed:
        pass
    with pytest.raises(SourceError, match=r"source gemini: cannot be reached at 127.0.0.1:\d+ \("):
        gemini(closed)


@pytest.mark.parametrize(
    ("name", "options", "line"),
    [
        ("gemini", {"model": "../files"}, "option model: expected a name"),
        ("gemini", {"size": "9K"}, "option size: expected 1K, 2K or 4K"),
        ("gemini", {"base_url": "file:///etc"}, "option base_url: expected http"),
        ("openai", {"base_url": "https://me:secret@host/v1"}, "without a key"),
        ("openai", {"base_url": "https://host/v1?key=secret"}, "without a key"),
        ("openai", {"base_url": "https://host:999999"}, "expected http"),
        ("openai", {"response_format": "png"}, "expected"),
        ("openai", {"key": KEY}, "no option 'key'"),
    ],
)
def test_options_that_are_refused(name: str, options: dict[str, str], line: str) -> None:
    with pytest.raises(SourceError) as error:
        open_source(name, options)
    assert line in str(error.value) and "secret" not in str(error.value) and KEY not in str(error.value)


@pytest.mark.parametrize("key", ["two words", "schlüssel", "a\x01b"])
def test_keys_that_are_none(service: FakeService, key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GEMINI_API_KEY", key)
    with pytest.raises(SourceError, match="GEMINI_API_KEY is not a valid key") as error:
        gemini(service)
    assert key not in str(error.value) and not service.calls


def test_the_second_variable(service: FakeService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GEMINI_API_KEY")
    monkeypatch.setenv("GOOGLE_API_KEY", "another-key")
    service.replies = [drawn(png())]
    gemini(service)
    assert service.calls[0].headers["x-goog-api-key"] == "another-key"


def test_masks_and_alpha_are_exact(service: FakeService) -> None:
    service.replies = [Reply({"data": [{"b64_json": text64(png())}]})]
    openai(service, request("rust", True))
    files = {name: content for name, file, content in service.calls[0].form() if file}
    assert list(files) == ["image", "mask"]
    sent = pixels(files["image"])
    assert np.abs(sent / 255 - request().image).max() <= 0.5 / 255 + 1e-6
