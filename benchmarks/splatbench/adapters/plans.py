"""What a system is given and how it is run, as data: each system's file makes a Plan, which adapters.py follows."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from splatbench.adapters import alignment, exchange
from splatbench.adapters.config import Section
from splatbench.methods import Work

PLACEHOLDERS = {
    "python": "the interpreter of the section",
    "repository": "the checkout of the section",
    "asset": "the asset as INRIA PLY, in its own frame",
    "views": "folder of renders of the asset with cameras, in the layout that the system reads",
    "edited": "the edited view, PNG",
    "render": "the same view of the asset before, PNG",
    "mask": "what was edited of it, PNG, 255 where it was",
    "edits": "folder of all edited views: edited_, render_, mask_000.png and transforms.json",
    "region": "closed mesh (GLB) around the rows that the edit reaches; VoxHammer only",
    "base": "folder of the posed views that the asset was built from; RelitLRM only",
    "prompt": "the instruction",
    "out": "folder for what the system makes",
    "seed": "a whole number",
}
"""Of `command` in the adapters file."""
RESULT = "edited.ply"
"""What a command of the user's own leaves in {out}, unless `result` says otherwise."""
Commands = tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Job:
    """One edit by one system."""

    work: Work
    own: Section
    folder: Path
    """Its files: in/ (for the system), work/ (where it runs), out/ (what it makes), log.txt."""
    seed: int
    cube: exchange.Cube
    """Of the asset."""

    @property
    def inputs(self) -> Path:
        return self.folder / "in"

    @property
    def workplace(self) -> Path:
        return self.folder / "work"

    @property
    def out(self) -> Path:
        return self.folder / "out"

    @property
    def prompt(self) -> str:
        return self.own.instruction(self.work.step.kind)


@dataclass(frozen=True)
class Plan:
    """How the system is run on what has been written for it."""

    edit: Commands
    """Timed as the edit."""
    result: Path
    """File that is read back."""
    frame: Callable[[], alignment.Frame]
    """Of the result, asked once it is there."""
    setup: Commands = ()
    """Timed as set-up, with the writing of the files."""
    export: Commands = ()
    """Only to make the result readable; timed apart."""
    values: dict[str, str] = field(default_factory=dict)
    """Placeholders beyond those that every job has."""
    check: Callable[[], None] = lambda: None
    """Asked between edit and export. Raises ValueError where the system ended well but did nothing."""
    note: str = ""
    """What the system saw of the edit."""


@dataclass(frozen=True)
class System:
    """A row."""

    name: str
    """Its table in the adapters file, and the method's name."""
    label: str
    protocols: tuple[str, ...]
    plan: Callable[[Job], Plan]
    """Writes what the system reads into job.inputs and job.workplace. Raises ValueError where it cannot."""
    needs: tuple[str, ...] = ()
    """Files of its checkout that must be there; (): it has none."""
    missing: Callable[[Section], str] = lambda _: ""
    """What else it needs that is not there, or ""."""


def common(job: Job) -> dict[str, str]:
    """Write what every system gets; the values of the placeholders."""
    from splatpainter import io
    from splatpainter.rendering import render
    from splatpainter.sources.color import to_display

    work, edits = job.work, job.inputs / "edits"
    for folder in (edits, job.out):
        folder.mkdir(parents=True)
    io.write(job.inputs / "asset.ply", work.asset)
    exchange.save_text(job.inputs / "prompt.txt", job.prompt)
    step = work.step
    names = [f"edited_{k:03d}.png" for k in range(len(step.edited))]
    for k, camera in enumerate(step.edited.cameras):
        before = to_display(render(work.asset, camera).colors[0], work.asset.color_space)
        exchange.save_picture(edits / names[k], step.edited.colors[k])
        exchange.save_picture(edits / f"render_{k:03d}.png", before)
        exchange.save_picture(edits / f"mask_{k:03d}.png", step.masks[k].astype(bool))
    told = exchange.transforms(step.edited.cameras, names)
    exchange.save_text(edits / "transforms.json", json.dumps(told))
    largest = int(step.masks.reshape(len(step.masks), -1).sum(1).argmax())
    return {
        "python": job.own.python,
        "repository": str(job.own.repository or ""),
        "asset": str(job.inputs / "asset.ply"),
        "views": str(job.inputs / "views"),
        "edited": str(edits / names[largest]),
        "render": str(edits / f"render_{largest:03d}.png"),
        "mask": str(edits / f"mask_{largest:03d}.png"),
        "edits": str(edits),
        "prompt": job.prompt,
        "out": str(job.out),
        "seed": str(job.seed),
    }


def filled(command: Iterable[str], values: dict[str, str]) -> tuple[str, ...]:
    """A command with its {placeholders} replaced. Raises ValueError for one that this system does not have."""

    def value(found: re.Match[str]) -> str:
        if found[1] not in values:
            raise ValueError(f"command: unknown placeholder {found[0]}; known here: {', '.join(sorted(values))}")
        return values[found[1]]

    return tuple(re.sub(r"\{([a-z_]+)\}", value, word) for word in command)


def overridden(plan: Plan, job: Job, values: dict[str, str]) -> Plan:
    """The plan with the user's own command, where the section has one."""
    own = job.own
    frames = {
        "asset": lambda: alignment.ASSET,
        "gltf": lambda: alignment.cube(job.cube.lo, job.cube.size, upright=False),
        "trellis": lambda: alignment.cube(job.cube.lo, job.cube.size, upright=True),
    }
    frame, result = plan.frame, plan.result
    if own.command:
        result = job.out / (own.result or RESULT)
        frame = plan.frame if own.result else frames["asset"]
    elif own.result:
        result = job.out / own.result
    if own.frame == "nerfstudio":
        frame = lambda: alignment.nerfstudio(result.with_name("dataparser_transforms.json"))  # noqa: E731
    elif own.frame:
        frame = frames[own.frame]
    if not own.command:
        return Plan(plan.edit, result, frame, plan.setup, plan.export, plan.values, plan.check, plan.note)
    return Plan((filled(own.command, values),), result, frame, values=plan.values, note=plan.note)


def checkout(job: Job, *hidden: str) -> None:
    """job.workplace as a folder that looks like the checkout but takes what the system writes: links to all in it,
    except `hidden` (paths in it) and what is there already, which become folders of their own."""
    assert job.own.repository is not None
    _linked(job.own.repository, job.workplace, "", hidden)
    for name in hidden:
        (job.workplace / name).mkdir(parents=True, exist_ok=True)


def _linked(source: Path, target: Path, inside: str, hidden: tuple[str, ...]) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for entry in sorted(os.listdir(source)):
        path = f"{inside}{entry}"
        if path in hidden or entry == ".git":
            continue
        if any(name.startswith(f"{path}/") for name in hidden):
            _linked(source / entry, target / entry, f"{path}/", hidden)
        else:
            link(target / entry, (source / entry).resolve())


def link(path: Path, target: Path) -> None:
    """A symbolic link at `path`, or a copy where the system allows none (Windows asks for a privilege). target:
    absolute, or relative to the link's folder."""
    try:
        path.symlink_to(target, target_is_directory=(path.parent / target).is_dir())
    except OSError:
        if path.is_symlink() or path.exists():
            raise
        source = path.parent / target
        shutil.copytree(source, path) if source.is_dir() else shutil.copy2(source, path)


def one_of(job: Job) -> str:
    """A note's part where the system took one view of several."""
    views = len(job.work.step.edited)
    return f", the one with the largest mask of {views}" if views > 1 else ""
