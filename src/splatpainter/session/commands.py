"""What every group of a session's commands stands on; Session has it all."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

from splatpainter.painter import Edit
from splatpainter.session.document import Document, Layer
from splatpainter.session.project_file import Transaction
from splatpainter.splats import Splats


class Commands(ABC):
    """A part of Session; see there."""

    _transaction: Transaction

    @property
    @abstractmethod
    def splats(self) -> Splats: ...

    @property
    @abstractmethod
    def _document(self) -> Document: ...

    @abstractmethod
    def layer(self, layer: str) -> Layer: ...

    @abstractmethod
    def _command(self) -> AbstractContextManager[None]: ...

    @abstractmethod
    def _commit(self, label: str, document: Document, *, strict: Any = None, gesture: str | None = None) -> None: ...

    @abstractmethod
    def _edits_of(self, layer: Layer, edits: Sequence[Edit]) -> list[Edit]: ...
