"""The adapters file (TOML): where the systems outside this package are. Knows no system's command line.

    [voxhammer]
    repository = "~/VoxHammer"                      # relative paths: beside the file
    python = "~/miniconda3/envs/hammer/bin/python"
    timeout_seconds = 3600
    environment = { HF_HOME = "/data/huggingface" }

Keys are the fields of `AdapterSection`.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from splatpainter.system.jsonio import build

SYSTEMS = ("voxhammer", "vinedresser3d", "dge", "instruct-gs2gs", "relitlrm")
"""Names of tables in the file."""
PROGRAMS = ("super-resolution",)
"""Tables that are not about a system (methods/super_resolution.py)."""
GUIDE = "docs/ADAPTERS.md"
SECRETS = re.compile(r"key|token|secret|password", re.IGNORECASE)


@dataclass(frozen=True)
class AdapterSection:
    """One table of the file."""

    name: str
    """Name of the system."""
    repository: Path | None = None
    """Checkout of the system."""
    python: str = ""
    """Python of the system's environment: a path, or a name to be found on PATH."""
    command: tuple[str, ...] = ()
    """Instead of the system's own commands, set-up and export included. Placeholders: systems.PLACEHOLDERS."""
    arguments: tuple[str, ...] = ()
    """Appended to the command that edits."""
    setup_arguments: tuple[str, ...] = ()
    """Appended to the command that sets up, where the system has one."""
    result: str = ""
    """File that `command` leaves, relative to {out}; "": where the system itself leaves it, or "edited.ply"."""
    frame: Literal["", "asset", "gltf", "trellis", "nerfstudio"] = ""
    """Axes of that file, as frames.py names them; "": the system's own, and "asset" for edited.ply."""
    prompt: str = ""
    """Instruction for systems that read text; "": the name of the kind of edit."""
    prompts: dict[str, str] = field(default_factory=dict)
    """Kind of edit (stroke, text, sticker, recolor, ...) -> instruction; goes before `prompt`."""
    views: int = 0
    """Rendered pictures of the asset that the system gets; 0: as many as it was made for."""
    size: int = 0
    """Edge of the pictures, pixels; 0: as the system wants."""
    timeout_seconds: float = 3600.0
    """Seconds that each command may take."""
    environment: dict[str, str] = field(default_factory=dict)
    """Variables that its process has besides this one's."""
    device: Literal["cuda", "cpu"] = "cuda"
    """"cuda": not run where the machine has no NVIDIA GPU; "cpu": run anywhere."""

    def __post_init__(self) -> None:
        if not self.timeout_seconds > 0:
            raise ValueError(f"timeout_seconds: expected seconds above 0, got {self.timeout_seconds:g}")
        for key, limit in (("views", 1000), ("size", 4096)):
            if not 0 <= getattr(self, key) <= limit:
                raise ValueError(f"{key}: expected a whole number from 0 to {limit}, got {getattr(self, key)}")

    def instruction(self, kind: str) -> str:
        """What a system that reads text is told for an edit of this kind."""
        return self.prompts.get(kind) or self.prompt or kind

    def digest(self) -> str:
        """12 hex digits of all that may change a result, the checkout's commit included; not of secrets."""
        values = {
            f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("timeout_seconds", "environment")
        }
        values["environment"] = {k: v for k, v in self.environment.items() if not SECRETS.search(k)}
        text = repr(sorted((k, str(v)) for k, v in values.items())) + commit(self.repository)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def sections(path: Path) -> dict[str, dict[str, Any]]:
    """Name of table -> its keys, unchecked. Raises ValueError for a file that is missing or no TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise ValueError(f"{path}: cannot be read as the adapters file ({reason}); see {GUIDE}") from None


def section(path: Path | None, name: str) -> AdapterSection | None:
    """The system's table, checked; None where the file has none, or there is no file. Other tables are not looked at.

    Raises ValueError: no such file, no TOML, an unknown key, a value of the wrong kind."""
    table = None if path is None else sections(path).get(name)
    if path is None or table is None:
        return None
    values = build(AdapterSection, table, f"{path}: [{name}]", what="a table of keys", base=AdapterSection(name))
    folder = path.parent  # where relative paths begin; links are kept: a virtual environment's python is one
    repository = values.repository and Path(os.path.abspath(folder / values.repository.expanduser()))
    python = values.python
    if os.path.dirname(python):
        python = os.path.abspath(folder / Path(python).expanduser())
    return replace(values, name=name, repository=repository, python=python)


def digest(path: Path | None, name: str) -> str:
    """Digest of the system's table (AdapterSection.digest); "none" where there is none that can be read."""
    try:
        values = section(path, name)
    except ValueError:
        values = None
    return "none" if values is None else values.digest()


def absent(path: Path | None, name: str) -> str:
    """Why a system without a table is not run."""
    line = f"not installed: add [{name}] to the adapters file ({GUIDE})"
    unknown = sorted(set(sections(path)) - {*SYSTEMS, *PROGRAMS}) if path is not None else []
    return line + (f"; [{unknown[0]}] is not one of {', '.join(SYSTEMS)}" if unknown else "")


def problem(section: AdapterSection, needs: tuple[str, ...], has_gpu: Callable[[], bool]) -> str:
    """What keeps a system from being run, or "". needs: files of its checkout; (): it has no checkout."""
    name, repository = section.name, section.repository
    if repository is not None and not repository.is_dir():
        return f"[{name}] repository: no folder {repository}"
    if needs and not section.command:
        if repository is None:
            return f"[{name}] has no `repository`: the path of its checkout ({GUIDE})"
        absent_files = [file for file in needs if not (repository / file).exists()]
        if absent_files:
            return f"[{name}] repository: {repository} has no {absent_files[0]}; is it a checkout of {name}?"
    if not section.python and (not section.command or any("{python}" in word for word in section.command)):
        return f"[{section.name}] has no `python`: the interpreter of its environment ({GUIDE})"
    if section.python and shutil.which(section.python) is None:
        return f"[{section.name}] python: no program {section.python}"
    if section.device == "cuda" and not has_gpu():
        return "needs a CUDA GPU"
    return ""


def has_cuda_gpu() -> bool:
    """Whether this machine shows an NVIDIA GPU to its processes. Not by our own torch: the systems bring theirs."""
    if os.environ.get("CUDA_VISIBLE_DEVICES", "all").strip() in ("", "-1"):
        return False
    if sys.platform == "win32":
        return shutil.which("nvidia-smi") is not None  # comes with the driver
    return any(Path("/dev").glob("nvidia[0-9]*")) or Path("/dev/dxg").exists()


def commit(repository: Path | None) -> str:
    """Commit of a checkout as git's own files tell it, "" where they do not."""
    if repository is None:
        return ""
    try:
        head = (repository / ".git" / "HEAD").read_text(encoding="utf-8").strip()
        if not head.startswith("ref: "):
            return head
        return (repository / ".git" / head[5:]).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
