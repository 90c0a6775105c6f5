"""What went wrong, as a client is told: one line, nothing of the machine's own folders."""

from __future__ import annotations

import logging
import sqlite3

from pydantic import ValidationError

from splatpainter.io.files import printable
from splatpainter.server.messages import Failure, Problem
from splatpainter.server.queue import Busy, Cancelled

log = logging.getLogger("splatpainter.server")


class Refused(Exception):
    """A command that failed, as its client is told."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.message)
        self.problem = problem


class TooLarge(ValueError):
    """More bytes than a limit allows."""


def problem_of(error: Exception) -> Problem:
    """What a client is told of a failure. Wrong input speaks for itself: its last part says what to do."""
    if isinstance(error, Refused):
        return error.problem
    if isinstance(error, Cancelled):
        return Problem(kind="cancelled", message="Cancelled; nothing was changed.")
    if isinstance(error, Busy):
        return Problem(kind="busy", message="Too much is waiting.", hint="Wait until the work in progress is done.")
    if isinstance(error, MemoryError):
        return Problem(kind="input", message="Out of memory.", hint="Use a smaller picture, or an asset of fewer rows.")
    if isinstance(error, ValidationError):
        return Problem(kind="input", message=first_fault(error, "studio"))
    if isinstance(error, ValueError) and not isinstance(error, sqlite3.Error):
        text = " ".join(str(error).encode("utf-8", "replace").decode().split())
        message, _, hint = text.rpartition("; ")
        return Problem(kind="input", message=message or hint, hint=hint if message else "")
    log.error("fault", exc_info=error)
    return Problem(kind="fault", message=f"Fault in the studio: {type(error).__name__}: {error}"[:300])


def first_fault(error: ValidationError, where: str) -> str:
    """One line about the first field that is wrong."""
    fault = error.errors(include_url=False, include_context=False, include_input=False)[0]
    field_path = printable(".".join(map(str, fault["loc"])))  # a client's own words
    return f"{where}: {field_path}: {fault['msg']}" if field_path else f"{where}: {fault['msg']}"


def failure(number: int, problem: Problem) -> Failure:
    """The answer of a command that failed."""
    return Failure(re=number, error=problem)
