"""The folder of a batch: what clients asked for, as a JOBS.yaml with its files beside it. Nothing in it is named by a
client but the results, and those by plain words of it.

    batch.yaml  project.splatproj  preview.json  assets/NAME.ply  looks/3/film.cube  out/NAME-VARIANT.ply
"""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import field
from pathlib import Path
from typing import Any

from splatpainter.batch.plan import JobList, read_jobs
from splatpainter.splats import Axes
from splatpainter.system.atomic import windows_refuses
from splatpainter.system.quick_dataclass import dataclass

JOBS, PROJECT, PREVIEW = "batch.yaml", "project.splatproj", "preview.json"
"""Files of the folder."""
ASSETS, LOOKS, OUT = "assets", "looks", "out"
"""Folders in it."""
PREVIEW_PX = 240
MAX_JOBS = 1000
"""Most jobs of one batch of a studio."""
MAX_STEM_BYTES = 100
"""Most bytes of the part of a result's name that comes from its asset."""
UNFIT = str.maketrans('*?:"<>|[]{}', "-------()()")
"""Characters that names may not hold: wildcards, where a JOBS.yaml takes other names in, and what Windows forbids."""
OF_JOBS_FILE = re.compile(rf"(?:.*[/\\])?{re.escape(JOBS)}(?::\d+)?: (?:variants(?:\[\d+\])?: )?")
"""Beginning of what is said of a JOBS.yaml, which clients have never seen."""


@dataclass
class BatchFolder:
    """Filled step by step; then `plan`."""

    root: Path
    axes: Axes = "auto"
    """Axes of the assets' numbers."""
    assets: list[Path] = field(default_factory=list)
    edits: list[dict[str, Any]] = field(default_factory=list)
    variants: list[dict[str, Any]] = field(default_factory=list)
    _stems: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        (self.root / ASSETS).mkdir(parents=True)

    @property
    def project(self) -> Path:
        """Where the project belongs whose layers are replayed."""
        return self.root / PROJECT

    def stem(self, name: str, ending: str = "") -> Path:
        """A path in `assets`, without its ending, for an asset that its owner calls `name`; no two are alike."""
        # Only the last part of a name counts, whichever system it comes from.
        base = re.split(r"[/\\]", name)[-1]
        if ending and base.lower().endswith(ending):
            base = base[: -len(ending)]
        base = _fit(base)
        # Cut by bytes, as file systems count them, and never within a letter.
        base = base.encode("utf-8", "replace")[:MAX_STEM_BYTES].decode("utf-8", "ignore").strip(" .") or "asset"
        # Some names are devices on Windows, whatever their ending.
        base = f"asset-{base}" if windows_refuses(f"{base}.ply") else base
        # Alike but for the case is the same file on some systems, so stems are compared without it.
        number, free = 1, base
        while free.casefold() in self._stems:
            number += 1
            free = f"{base}-{number}"
        self._stems.add(free.casefold())
        return self.root / ASSETS / free

    def add_file(self, source: Path, name: str, ending: str) -> None:
        """An asset, by a link where the system has them. name: what its owner calls it; ending: of its format. Raises
        ValueError: it cannot be kept."""
        # The ending is the content's own, so that the reader does not trust the name.
        stem = self.stem(name, ending)
        target = stem.with_name(stem.name + ending)
        _link(source, target, name)
        self.assets.append(target)

    def look_file(self, number: int, source: Path, name: str, ending: str) -> str:
        """A LUT, or a picture to match, of a variant; its name in the JOBS.yaml."""
        # Each variant has a folder of its own: two files of one name may differ.
        folder = self.root / LOOKS / str(number)
        folder.mkdir(parents=True, exist_ok=True)
        stem = Path(re.split(r"[/\\]", name)[-1]).stem
        base = _fit(stem)[:60]
        target = folder / f"{base or 'look'}{ending}"
        _link(source, target, name)
        return target.relative_to(self.root).as_posix()

    def plan(self, format: str, camera: str | None) -> JobList:
        """Write the JOBS.yaml and read it as `splatpainter batch` does. camera: JSON of that of the previews; None:
        from the front. Raises ValueError of one line."""
        # Counted before anything is written: assets times variants grow quickly.
        count = len(self.assets) * max(len(self.variants), 1)
        if count > MAX_JOBS:
            raise ValueError(f"batch: expected at most {MAX_JOBS} results, got {count}; make several batches of it")
        preview: dict[str, Any] = {"size": PREVIEW_PX}
        # The same file that `splatpainter batch` reads, so that the studio has no second way to run one.
        try:
            if camera is not None:
                (self.root / PREVIEW).write_text(camera, encoding="utf-8")
                preview["camera"] = PREVIEW
            jobs = {
                "assets": [f"{ASSETS}/{path.name}" for path in self.assets],
                "out": OUT,
                "edits": self.edits,
                "variants": self.variants,
                "format": format,
                "axes": self.axes,
                "preview": preview,
            }
            (self.root / JOBS).write_text(json.dumps(jobs, ensure_ascii=False), encoding="utf-8")
        except OSError as error:
            raise ValueError(f"batch: cannot be kept ({error.strerror or error})") from None
        # Errors name the JOBS.yaml by its lines, which clients have never seen.
        try:
            return read_jobs(self.root / JOBS)
        except ValueError as error:
            raise ValueError(f"batch: {OF_JOBS_FILE.sub('', str(error), count=1)}") from None


def _fit(name: str) -> str:
    return "".join(c if c.isprintable() else "-" for c in name.translate(UNFIT)).strip(" .")


def _link(source: Path, target: Path, name: str) -> None:
    try:
        # A link costs no room; a batch may have hundreds of assets.
        try:
            os.link(source, target)
        except OSError:  # another disk, or a system without links
            shutil.copyfile(source, target)
    except OSError as error:
        raise ValueError(f"{name}: cannot be kept ({error.strerror or error})") from None
