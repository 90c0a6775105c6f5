"""What a target is, the rule for messages, and the list of targets."""

from __future__ import annotations

import importlib
import importlib.util
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

LONGEST_MESSAGE = 600
"""Characters of a refusal."""


class Fault(AssertionError):
    """The program broke a promise on this input."""


@dataclass
class Verdict:
    """What became of an input (of several, where an input is a script of messages)."""

    opened: int = 0
    refused: int = 0


class Target:
    """One kind of input. It is made once in each worker, with a folder of its own for its files."""

    name: str
    memory_limit = 256 << 20
    """Bytes by which one input may raise the peak of the process."""
    seconds_limit = 4.0
    """CPU seconds that one input may take."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        """Exists; on a file system in memory where there is one."""

    def make(self, rng: random.Random) -> dict[str, bytes]:
        """The input: file name -> bytes."""
        raise NotImplementedError

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        """Try the input. Raises Fault, or whatever the program raised that it should not have."""
        raise NotImplementedError

    def warm_up(self) -> None:
        """Done once, before limits are set: kernels are compiled, modules imported."""

    def close(self) -> None:
        """Leave nothing open."""


def refusal(error: ValueError, *names: str) -> None:
    """Check the message of a ValueError: its type, one short printable line, naming one of `names`."""
    message = str(error)
    if type(error) is not ValueError:
        raise Fault(f"raised {type(error).__name__}, expected ValueError: {message[:200]}") from error
    if not message or len(message) > LONGEST_MESSAGE:
        raise Fault(f"a message of {len(message)} characters: {message[:200]}") from error
    if not message.isprintable():
        raise Fault(f"a message that is not one printable line: {message[:300]!r}") from error
    if names and not any(name in message for name in names):
        raise Fault(f"a message that names none of {', '.join(names)}: {message[:300]}") from error


def rng_of(name: str, seed: int) -> random.Random:
    """The source of all chance of one input."""
    return random.Random(f"{name}/{seed}")


_MODULES = {
    "ply": "ply_targets",
    "text-ply": "ply_targets",
    "compressed-ply": "ply_targets",
    "splat": "packed_targets",
    "ksplat": "packed_targets",
    "spz": "packed_targets",
    "glb": "packed_targets",
    "sog": "sog_targets",
    "sog-folder": "sog_targets",
    "picture": "picture_target",
    "capture": "capture_target",
    "project": "project_target",
    "verify": "verify_target",
    "studio": "studio_target",
}
"""Target -> module of this package with a class or function in its TARGETS of that name."""
_SPECIMENS = ("raises", "warns", "dies", "hangs", "swells", "late")
"""Targets of specimens.py: faults on purpose, to see that they are noticed."""


def names() -> list[str]:
    """All targets whose module is there."""
    return [name for name, module in _MODULES.items() if importlib.util.find_spec(f"{__package__}.{module}")]


def make_target(name: str, folder: Path) -> Target:
    """The target of a name, ready. Raises ValueError for unknown names."""
    if name not in (*names(), *_SPECIMENS):
        raise ValueError(f"fuzz: unknown target {name!r}; expected one of {', '.join(names())}")
    module = importlib.import_module(f"{__package__}.{_MODULES.get(name, 'specimens')}")
    factory: Callable[[Path], Target] = module.TARGETS[name]
    return factory(folder)
