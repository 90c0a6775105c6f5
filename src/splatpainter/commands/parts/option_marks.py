"""What a command's dataclass says of a field besides its type. Loads no parser: most command lines need none.

asset: Annotated[Positional[Path], Argument(metavar="ASSET")]
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, TypeAlias, TypeVar

T = TypeVar("T")


class ByPosition:
    """Marks a field that is given by its place, without a name."""


BY_POSITION = ByPosition()
Positional: TypeAlias = Annotated[T, BY_POSITION]


class Argument(NamedTuple):
    """How an option is shown and what else it is called; as tyro.conf.arg, which it becomes where tyro is needed."""

    metavar: str | None = None
    help_behavior_hint: str | None = None
    """What help says of its default; None: the default."""
    aliases: tuple[str, ...] = ()
    """Other names, with their dashes."""
