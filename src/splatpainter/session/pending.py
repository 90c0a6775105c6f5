"""What a command has prepared and not committed yet, in front of what the project file holds."""

from __future__ import annotations

from splatpainter.session.project import Additions, Project
from splatpainter.session.replay import Painted


class Pending:
    """Pictures and results by hash: new ones in memory until they are committed, all others in the project file."""

    def __init__(self, project: Project) -> None:
        self.project, self.more = project, Additions()

    def drop(self) -> None:
        """Forget what is new: it was committed, or its command failed."""
        self.more = Additions()

    def blob(self, sha256: str) -> bytes:
        """Bytes of a picture. Raises ValueError: unknown or damaged."""
        return self.more.blobs.get(sha256) or self.project.blob(sha256)

    def get(self, key: str) -> Painted | None:
        """A result, None where there is none that can be read: it is computed again, and `verify` reports damage."""
        try:
            return self.more.results.get(key) or self.project.result(key)
        except ValueError:
            return None

    def put(self, key: str, painted: Painted) -> None:
        if not self.project.read_only:
            self.more.results[key] = painted
