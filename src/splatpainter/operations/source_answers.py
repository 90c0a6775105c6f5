"""Picture sources as operations on files ask them: they can be interrupted, and what they answered is not lost.

A picture that cannot be painted was made, and often paid for, all the same: where anything fails afterwards, it is
written beside the file that was to be.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from splatpainter.image_files import CAMERA_KEYWORD, encode_png, quantized
from splatpainter.operations.operation import Tools
from splatpainter.sources.picture_source import (
    CancelFlag,
    PictureAnswer,
    PictureRequest,
    PictureSource,
    Progress,
    SourceError,
)
from splatpainter.system.atomic import brief_name, writing

POLL_SECONDS = 0.1
"""Seconds between two looks at whether a source has answered."""
MAX_ANSWER_FILES = 1000
"""Names OUT.answer_1.png ... that are tried."""
CANCEL_SECONDS = 15.0
"""A source that was told to stop is waited for at most so long."""


class InterruptibleSource:
    """A source that works in a thread, so that Ctrl-C reaches it as `cancel` at once. It keeps what came back."""

    def __init__(self, source: PictureSource) -> None:
        self._source = source
        self.name, self.capabilities = source.name, source.capabilities
        self.answers: list[tuple[PictureRequest, PictureAnswer]] = []

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """Edit as the source does. An interrupt cancels it, waits for its end and goes on."""
        stop, done, outcome = threading.Event(), threading.Event(), []

        # Either side may cancel: the user at the keyboard, or whoever runs the operation.
        class AnyCancelFlag:
            def is_set(self) -> bool:
                return stop.is_set() or cancel.is_set()

        def work() -> None:
            try:
                outcome.append(self._source.edit(request, progress, AnyCancelFlag()))
            except BaseException as error:  # raised again below, where somebody waits for it
                outcome.append(error)
            done.set()

        # A thread of its own, so that Ctrl-C is heard here at once and reaches the source as `cancel`.
        threading.Thread(target=work, name=f"source {self.name}", daemon=True).start()
        try:
            while not done.wait(POLL_SECONDS):  # and not join, which forgets a thread when it is interrupted
                pass
        except BaseException:
            # The source is asked to stop and is waited for, since it may hold a connection or a program.
            stop.set()
            done.wait(CANCEL_SECONDS)
            raise
        (result,) = outcome
        if isinstance(result, BaseException):
            raise result
        # Kept even if what follows fails: the picture was made, and often paid for.
        self.answers.append((request, result))
        return result

    def write_answers(self, out: Path, painted: Sequence[PictureAnswer] = ()) -> list[Path]:
        """Write what came back and was not painted beside OUT, as OUT.answer_1.png and so on with their cameras inside,
        over no file that is there. Returns their names; none where they cannot be written."""
        paths: list[Path] = []
        for request, answer in self.answers:
            # What went onto the asset needs no second place.
            if any(one is answer for one in painted):
                continue
            # The first name that is free: nothing of an earlier failure is overwritten.
            stem = brief_name(out.name)
            names = (out.with_name(f"{stem}.answer_{number}.png") for number in range(1, MAX_ANSWER_FILES))
            path = next((name for name in names if not name.exists()), None)
            carried = {CAMERA_KEYWORD: request.camera.to_json()} if request.camera is not None else None
            # Saving is a courtesy after a failure; it must not hide that failure behind its own.
            with contextlib.suppress(OSError, ValueError):
                if path is not None:
                    with writing(path) as file:
                        file.write(encode_png(quantized(answer.image), carried))
                    paths.append(path)
        return paths


def interruptible(tools: Tools) -> tuple[Tools, list[InterruptibleSource]]:
    """The tools, whose sources are interruptible, and the list of those that were opened, which grows."""
    opened: list[InterruptibleSource] = []

    def open_source(name: str, options) -> PictureSource:
        opened.append(InterruptibleSource(tools.open_source(name, options)))
        return opened[-1]

    return replace(tools, open_source=open_source), opened


@contextlib.contextmanager
def keeping_answers(
    sources: Sequence[InterruptibleSource], out: Path, complain: Callable[[str], None]
) -> Iterator[None]:
    """Where the block fails, what the sources answered is written beside OUT, and the error says where; complain:
    takes that line where the error is none of ours."""
    try:
        yield
    except BaseException as error:
        from splatpainter.gatekeeper.gatekeeper import RefusedPicture  # which takes a while to load

        # Written in any case, also after Ctrl-C: the pictures are what cost time and money.
        paths = [path for source in sources for path in source.write_answers(out)]
        lines = answers_line(paths)
        # Errors of ours carry the line themselves; of any other the type and text stay as they are.
        if lines and type(error) in (ValueError, SourceError, RefusedPicture):
            raise type(error)(f"{error}; {lines[0]}") from None
        for line in lines:
            complain(line)
        raise


def answers_line(paths: Sequence[Path]) -> list[str]:
    """What there is to say of answers that were written; nothing of none."""
    return [f"what came back is kept: {', '.join(map(str, paths))}"] if paths else []
