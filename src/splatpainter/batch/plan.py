"""From a JOBS.yaml to numbered jobs: assets found, names given, paths resolved, missing files named by their line."""

from __future__ import annotations

import glob
import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, field, fields, replace
from pathlib import Path
from typing import Any

from splatpainter.batch.schema import OLD_KEYS, Batch, file_paths, with_values
from splatpainter.io import FORMATS, format_of_name
from splatpainter.io.files import file_sha256
from splatpainter.io.formats.sog_container import META
from splatpainter.operations.operation import Operation
from splatpainter.splats import Axes
from splatpainter.system.atomic import check_name
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.yamlio import Lines, read

MAX_JOBS = 100_000
MASK, OF_PROJECT = "mask=", ("selection=", "layer=")
"""Terms of `where` that name files: MASK.png@CAMERA.json, and NAME@PROJECT.splatproj."""


@dataclass(frozen=True)
class JobStep:
    """One edit of a job, its paths resolved."""

    kind: str
    step: Operation
    """What is done."""
    lines: tuple[tuple[str, str], ...]
    """(file, FILE:LINE where the jobs file names it) of what it reads."""

    def describe(self) -> dict[str, Any]:
        """JSON values that decide what it does; files by their names and bytes, wherever they are."""
        text = json.dumps(asdict(self.step), default=str)
        for path in sorted((path for path, _ in self.lines), key=len, reverse=True):
            text = text.replace(json.dumps(path)[1:-1], json.dumps(Path(path).name)[1:-1])
        return {"kind": self.kind, "files": [file_sha256(Path(path)) for path, _ in self.lines], **json.loads(text)}

    def check(self) -> None:
        """Raises ValueError with the line of the jobs file that names a file which is not there."""
        for path, line in self.lines:
            if not Path(path).is_file():
                raise ValueError(f"{line}: {path}: no such file")


@dataclass(frozen=True)
class Job:
    """One asset in one variant."""

    name: str
    asset: Path
    variant: str
    out: Path
    folder: Path
    """Folder of its record, its pictures, and what is not finished yet."""
    steps: tuple[JobStep, ...]
    axes: Axes = "auto"
    preview_camera: str = ""
    preview_px: int = 320
    overwrite: bool = False
    """Replace a result that no batch made."""
    common: int = 0
    """How many of the first steps other variants of the asset have as well."""

    def hashes(self) -> list[str]:
        """Per step, a hash of all that its result depends on: the asset's bytes and every edit up to it. Raises
        ValueError: a file is missing."""
        for step in self.steps:
            step.check()
        digest = _hash(f"{_asset_digest(self.asset)} {self.axes}")
        out = []
        for step in self.steps:
            digest = _hash(f"{digest} {json.dumps(step.describe(), sort_keys=True)}")
            out.append(digest)
        return out


@dataclass(frozen=True)
class JobList:
    """All jobs of a file."""

    file: Path
    out: Path
    jobs: tuple[Job, ...] = field(repr=False, default=())


def read_jobs(path: Path, overwrite: bool = False) -> JobList:
    """Raises ValueError `FILE:LINE: ...`: what `yamlio.read` refuses, assets and files that are missing (those whose
    name holds {asset} or {variant} fail their own jobs only), results that would have one name."""
    # Everything is checked before the first job begins: a mistake in line 200 must not cost a night.
    batch, lines = read(Batch, path, OLD_KEYS)
    folder = path.parent
    out = folder / batch.out
    asset_keys = {}  # an asset that two patterns name is one asset
    for k, pattern in enumerate(batch.assets):
        for asset in _assets(folder, pattern, lines, k, out):
            asset_keys.setdefault(asset, f"assets[{k}]")
    assets = list(asset_keys.items())
    # Results need names apart, also on file systems that know no upper case.
    named = _names([asset for asset, _ in assets])
    variants = [(v.name, v.edits, f"variants[{k}].edits") for k, v in enumerate(batch.variants)] or [("", (), "")]
    if len(assets) * len(variants) > MAX_JOBS:
        raise ValueError(f"{path}: expected at most {MAX_JOBS} jobs, got {len(assets) * len(variants)}")
    preview = str(folder / batch.preview.camera) if batch.preview.camera else ""
    if preview and not Path(preview).is_file():
        raise ValueError(f"{lines.at('preview.camera')}: {preview}: no such file")
    jobs, line_of = [], {}
    for (asset, key_path), asset_name in zip(assets, named, strict=True):
        for variant, extra, extra_path in variants:
            name = f"{asset_name}-{variant}" if variant else asset_name
            target = out / f"{name}.{batch.format or _suffix(asset)}"
            try:
                check_name(target)
            except ValueError as error:
                raise ValueError(f"{lines.at(key_path)}: {error}") from None
            # A result must replace neither its own asset nor another result.
            key = str(target).lower()
            if target in asset_keys:
                raise ValueError(
                    f"{lines.at(key_path)}: {target} would be replaced by its own result; name another out"
                )
            if key in line_of:
                raise ValueError(f"{lines.at(key_path)}: {target.name} would be the result of {line_of[key]} too")
            line_of[key] = lines.at(key_path)
            steps = [
                *(_step(e, f"edits[{k}]", folder, lines, asset_name, variant) for k, e in enumerate(batch.edits)),
                *(_step(e, f"{extra_path}[{k}]", folder, lines, asset_name, variant) for k, e in enumerate(extra)),
            ]
            jobs.append(
                Job(name, asset, variant, target, out / "jobs" / name, tuple(steps), batch.axes, preview,
                    batch.preview.size, overwrite, len(batch.edits) if len(variants) > 1 else 0)
            )  # fmt: skip
    return JobList(path, out, tuple(jobs))


def _assets(folder: Path, pattern: str, lines: Lines, k: int, out: Path) -> list[Path]:
    """The files of a pattern, but for results of this batch."""
    where = lines.at(f"assets[{k}]")
    if not any(c in pattern for c in "*?["):
        path = folder / pattern
        if not path.exists():
            raise ValueError(f"{where}: {path}: no such file")
        if format_of_name(path) is None and not path.is_dir():
            raise ValueError(f"{where}: {path}: expected a splat file")
        return [path]
    # A pattern finds the results of the last run, too, where they lie in the same folder: those are no assets.
    matches = [folder / name for name in sorted(glob.glob(pattern, root_dir=folder, recursive=True))]
    matches = [path for path in matches if path.is_file() and format_of_name(path) is not None]
    made = [
        path for path in matches if path.parent.resolve() == out.resolve() and (out / "jobs" / _stem(path)).is_dir()
    ]
    matches = [path for path in matches if path not in made]
    if not matches:
        raise ValueError(f"{where}: {pattern}: no splat file has such a name")
    return matches


def _names(assets: Sequence[Path]) -> list[str]:
    """A name for each asset: that of its file, with its folder's in front where several files have one name."""
    short = [_stem(asset) for asset in assets]
    count = Counter(name.lower() for name in short)
    return [
        f"{asset.resolve().parent.name}-{name}" if count[name.lower()] > 1 else name
        for asset, name in zip(assets, short, strict=True)
    ]


def _stem(asset: Path) -> str:
    if asset.is_dir() or asset.name.lower() == META:
        return (asset if asset.is_dir() else asset.resolve().parent).name
    return asset.name[: -len(_ending(asset))] or asset.name


def _ending(path: Path) -> str:
    """The ending that says the format, with its dot: ".compressed.ply"."""
    endings = [suffix for entry in FORMATS.values() for suffix in entry.suffixes]
    fitting = [suffix for suffix in endings if path.name.lower().endswith(suffix)]
    return max(fitting, key=len, default=path.suffix)


def _suffix(asset: Path) -> str:
    """The format of an asset's result, where none is asked for: its own if it is one file and can be written."""
    key = format_of_name(asset)
    if asset.is_dir() or asset.name.lower() == META:
        return "sog"
    return "ply" if key is None or FORMATS[key].write is None else _ending(asset).lstrip(".")


def _step(edit: Any, path: str, folder: Path, lines: Lines, asset: str, variant: str) -> JobStep:
    """A step of the job, with {asset} and {variant} written out. Raises ValueError for a missing file whose name holds
    neither."""
    step, kind = edit.step, edit.kind
    # Every path is resolved against the jobs file, and remembered with its line for what is missing.
    files: list[tuple[str, str]] = []
    values: dict[str, Any] = {}
    for name, value in asdict(step).items():
        values[name] = with_values(value, asset, variant)
    for name, given in file_paths(step).items():
        full = [str(folder / with_values(entry, asset, variant)) for entry in given]
        original = getattr(step, name)
        paths = tuple(map(Path, full))
        values[name] = paths if isinstance(original, tuple) else (paths[0] if paths else original)
        for k, (entry, target) in enumerate(zip(given, full, strict=True)):
            index = f"[{k}]" if isinstance(original, tuple) else ""
            files.append((target, _checked(entry, target, lines.at(f"{path}.{kind}.{name}{index}"))))
    for entry in fields(step):
        if entry.metadata.get("output") and values[entry.name]:
            values[entry.name] = folder / values[entry.name]
    # Options of sources may be files (a model, a workflow); which ones, only the source knows.
    if "options" in values:
        given_options = values["options"] = dict(values["options"])
        for key, value in given_options.items():
            if isinstance(value, str) and value and (folder / value).is_file():
                given_options[key] = str(folder / value)
                files.append((str(folder / value), lines.at(f"{path}.{kind}.options.{key}")))
    for name in [entry.name for entry in fields(step) if entry.metadata.get("holds") == "region"]:
        terms = [
            _where_term(term, folder, lines.at(f"{path}.{kind}.{name}[{k}]"), files)
            for k, term in enumerate(values[name])
        ]
        values[name] = tuple(terms)
    try:
        return JobStep(kind, replace(step, **values).operation(), tuple(files))
    except ValueError as error:
        raise ValueError(f"{lines.at(f'{path}.{kind}')}: {error}") from None


def _checked(name: str, target: str, line: str) -> str:
    if "{" not in name and not Path(target).is_file():
        raise ValueError(f"{line}: {target}: no such file")
    return line


def _where_term(term: str, folder: Path, line: str, files: list[tuple[str, str]]) -> str:
    """A term (`mask=M.png@CAM.json`, `selection=NAME@P.splatproj`, `layer=...`) with paths of this machine."""
    inverted, bare = ("not:", term[4:]) if term.startswith("not:") else ("", term)
    kind, equals, value = bare.partition("=")
    if kind + equals in OF_PROJECT and "@" in value:
        title, _, name = value.rpartition("@")
        names, start = [str(folder / name)], f"{kind}={title}@"
    elif bare.startswith(MASK):
        names, start = [str(folder / name) for name in value.split("@") if name], MASK
    else:
        return term
    for name in names:
        files.append((name, _checked(name, name, line)))
    return inverted + start + "@".join(names)


def _asset_digest(asset: Path) -> str:
    """SHA-256 of an asset's bytes; of a folder of SOG planes: of all of them."""
    # A SOG folder is its planes, not the name of its meta file.
    folder = asset if asset.is_dir() else asset.parent
    if asset.is_dir() or asset.name.lower() == META:
        members = [folder / META, *sorted(path for path in folder.iterdir() if path.suffix.lower() == ".webp")]
        return _hash(" ".join(file_sha256(member) for member in members))
    return file_sha256(asset)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
