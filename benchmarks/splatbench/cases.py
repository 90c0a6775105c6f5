"""What a table asks of a method and what came of it, and every path and digest under which either lies on disk.

    OUT/TABLE/setup.json                  the setup that the cases are of
    OUT/TABLE/cases/LABEL/                case.json, case.npz, input.png, before.png, truth.png, and, last, stamp.json
    OUT/TABLE/failed/LABEL.json           what could not be made, and why; tried again by the next run
    OUT/TABLE/records/METHOD/LABEL.json   one method on one case, LABEL.png beside it
    OUT/TABLE/logs/                       of worker processes

Knows no method. `Case.save` and `Case.load` keep ground truth on disk, so that it is path traced once.
V views of H x W pixels, W novel views, N Gaussians.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import write_png
from splatpainter.io import files
from splatpainter.painter import Mode
from splatpainter.splats import ATTRIBUTES, Splats

VERSION = 2
"""Version of the files of a case: those of another one are made anew."""
MAX_NAME_CHARS = 80
Redo = Literal["nothing", "errors", "all"]
"""Which records that are up to date are made anew."""
DATA_FOLDERS = ("data", "environments", "decals", "fonts", "textures")
"""Fields of Setup."""


@dataclass(frozen=True)
class Setup:
    """Data, sizes and seed of all tables of a run. Equal setups give equal cases."""

    data: Path | None = None
    """Folder of meshes (or, where a table takes them, of splat assets); None: procedural objects."""
    environments: Path | None = None
    """Folder of .hdr/.exr pictures; None: procedural light."""
    decals: Path | None = None
    fonts: Path | None = None
    textures: Path | None = None
    objects: int = 8
    """How many objects."""
    held_out: bool = True
    """Only objects that training never sees (data.object_sources.split with its defaults); False: any."""
    names: Path | None = None
    """Text file of the objects to measure, one name a line, which training held out by the same list; None: those of
    the split."""
    size: int = 256
    """Pixels of every picture's edge; the paper: 512."""
    detail: int = 4
    """Zoom of close-ups: they are crops of pictures `detail` times larger (2K for the paper's 512)."""
    samples: int = 64
    """Paths per pixel of path traced truth."""
    truth: str = "traced"
    """"traced" (Mitsuba) or "surfels" (dense Gaussians, seconds instead of minutes; approximate light)."""
    base_views: int = 9
    rows: int = 30_000
    """Gaussians of assets that are built here."""
    asset_steps: int = 500
    """Optimisation steps in building an asset from its base views."""
    novel_views: int = 6
    lights: int = 3
    """Target environments per object in relighting; the paper: 24."""
    seed: int = 0


MIN_OPTIONS = {"objects": 1, "size": 64, "rows": 100, "novel_views": 1, "seed": 0}
"""Smallest values of the options of benchmarks that make their cases themselves."""


def check_options(benchmark: str, config: Any, folders: Sequence[str]) -> None:
    """Raises ValueError in the name of a benchmark: an option below MIN_OPTIONS, one of `folders` (names of options)
    that is not there."""
    for name, minimum in MIN_OPTIONS.items():
        if getattr(config, name) < minimum:
            option = name.replace("_", "-")
            raise ValueError(
                f"bench {benchmark}: expected --{option} of at least {minimum}, got {getattr(config, name)}"
            )
    for name in folders:
        folder = getattr(config, name)
        if folder is not None and not folder.is_dir():
            raise ValueError(f"bench {benchmark}: {name.replace('_', ' ')}: {folder}: no such folder")


@dataclass(frozen=True)
class Budget:
    """What a method may spend, and where it finds what it needs; the same for every method of a run."""

    steps: int = 1000
    """Steps of methods that optimise."""
    device: str = "cpu"
    """"cpu" or "cuda"."""
    seed: int = 0
    weights: dict[str, str] = field(default_factory=dict)
    """Name of a model -> folder of its weights, for methods that need other weights than the shipped ones, e.g.
    {"compact": ..., "genden": ..., "cross-attention": ..., "latent-query": ...}."""
    adapters: Path | None = None
    """TOML file that says how systems outside this package are called; None: none is installed."""
    scratch: Path | None = None
    """Folder for a method's working files; None: it makes a temporary one."""
    curve: bool = False
    """Methods that take many steps also return what they had on the way (EditResult.curve)."""


@dataclass(frozen=True)
class RunConfig:
    """One run of one table; the same for all its parts."""

    protocol: str
    """Name of the table."""
    setup: Setup
    methods: Sequence[str]
    """Names, in any order."""
    budget: Budget
    out: Path
    processes: int = 1
    """Processes that make ground truth at once."""
    shard: tuple[int, int] = (0, 1)
    """(k, n): only the objects k, k + n, ...; machines with the other k fill the same folder."""
    redo: Redo = "nothing"
    perceptual: Path | None = None
    """Folder of the LPIPS-Alex weights; None: no LPIPS."""
    parallel_methods: bool = False
    """Methods run side by side, `processes` at a time: their seconds say less, and the table says so."""
    named: bool = False
    """The methods were given by name: one that cannot run here then leaves the table incomplete."""


def to_json(value: Setup | Budget) -> dict[str, Any]:
    """A setup or a budget as JSON values, for `jsonio.build`; paths become absolute."""
    return {k: str(v.absolute()) if isinstance(v, Path) else v for k, v in asdict(value).items()}


@dataclass(frozen=True)
class CaseKey:
    """A case before it is made."""

    label: str
    """File-name safe, unique in its table."""
    name: str
    """Name of the object."""
    settings: dict[str, Any]
    """JSON values that, with the setup, say everything about it."""


@dataclass(frozen=True)
class PosedImages:
    """V pictures of one size and their cameras."""

    cameras: tuple[Camera, ...]
    """V."""
    colors: np.ndarray = field(repr=False)
    """[V, H, W, 3] float32 display sRGB 0..1, over each camera's background."""

    def __post_init__(self) -> None:
        if self.colors.ndim != 4 or self.colors.shape[0] != len(self.cameras) or self.colors.shape[3] != 3:
            raise ValueError(
                f"pictures: expected [{len(self.cameras)}, H, W, 3] for as many cameras, got {list(self.colors.shape)}"
            )

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[tuple[Camera, np.ndarray]]:
        """(camera, [H, W, 3]) of each view."""
        return zip(self.cameras, self.colors, strict=True)

    def take(self, views: Any) -> PosedImages:
        """These views (indices, or bools), in their order."""
        chosen = np.arange(len(self))[np.asarray(views)]
        return PosedImages(tuple(self.cameras[k] for k in chosen), self.colors[chosen])

    @staticmethod
    def joined(parts: Sequence[PosedImages]) -> PosedImages:
        """All views of pictures of one size, in order."""
        cameras = tuple(camera for part in parts for camera in part.cameras)
        return PosedImages(cameras, np.concatenate([part.colors for part in parts]))


@dataclass(frozen=True)
class EditStep:
    """One edit: what an artist hands in at once."""

    mode: Mode
    kind: str
    """zoom, stroke, text, sticker, photo, recolor, relight and others."""
    edited: PosedImages
    """V >= 1 edited views."""
    masks: np.ndarray = field(repr=False)
    """[V, H, W] bool what was edited; where the object is, for zooms and global kinds."""


@dataclass(frozen=True)
class Case:
    """One task of a table: an asset, its edits and the true views."""

    protocol: str
    """Name of the table."""
    name: str
    """Name of the object."""
    label: str
    """Label of the case among those of its table: file-name safe and unique, e.g. "gso_dino_3-relight-2views"."""
    asset: Splats = field(repr=False)
    """The asset as the artist has it: numpy float32, N Gaussians."""
    base: PosedImages
    """Views of the unedited truth that the asset was built from."""
    steps: tuple[EditStep, ...]
    """The edits, in order; most tables have one."""
    before: PosedImages
    """Novel views of the object before the edits (truth)."""
    after: PosedImages
    """The same views after the last edit (truth)."""
    near: np.ndarray = field(repr=False)
    """[W] bool: the novel view is near the edit."""
    true_views: PosedImages | None = None
    """Edited views of the truth from all around, for methods that see the truth; no other method gets them. None:
    there are none (edits made on a picture alone)."""
    setup_seconds: float = 0.0
    """What building the asset took, where it was built for this case."""
    facts: dict[str, Any] = field(default_factory=dict)
    """JSON values for notes and plots: views, environment, samples per pixel, source of truth and others."""

    @property
    def most_changed_view(self) -> int | None:
        """The novel view with the largest change of its truth, among those near the edit where there are any; None
        without novel views."""
        if not len(self.after):
            return None
        change = np.abs(self.after.colors - self.before.colors).sum((1, 2, 3))
        return int(np.argmax(np.where(self.near, change, -1.0) if self.near.any() else change))

    def save(self, folder: Path) -> None:
        """Write the case as case.json and case.npz (pictures as float16: 66 dB and more)."""
        arrays: dict[str, np.ndarray] = {f"asset_{name}": getattr(self.asset, name) for name in ATTRIBUTES}
        arrays["near"] = self.near
        images = {"base": self.base, "before": self.before, "after": self.after}
        if self.true_views is not None:
            images["oracle"] = self.true_views
        images |= {f"step{k}": step.edited for k, step in enumerate(self.steps)}
        arrays |= {name: some.colors.astype(np.float16) for name, some in images.items()}
        arrays |= {f"step{k}_masks": np.packbits(step.masks, axis=-1) for k, step in enumerate(self.steps)}
        values = {
            "version": VERSION,
            "protocol": self.protocol,
            "name": self.name,
            "label": self.label,
            "setup_seconds": self.setup_seconds,
            "facts": self.facts,
            "antialiased": self.asset.antialiased,
            "color_space": self.asset.color_space,
            "steps": [{"mode": step.mode, "kind": step.kind} for step in self.steps],
            "cameras": {name: [c.to_json() for c in some.cameras] for name, some in images.items()},
        }
        folder.mkdir(parents=True, exist_ok=True)
        with files.writing(folder / "case.npz") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        _write_json(folder / "case.json", values)

    @staticmethod
    def load(folder: Path) -> Case:
        """Raises ValueError where the folder holds no complete case of this version."""
        try:
            values = json.loads((folder / "case.json").read_bytes())
            if values["version"] != VERSION:
                raise ValueError(f"version {values['version']}")
            with np.load(folder / "case.npz", allow_pickle=False) as arrays:
                return _case(values, dict(arrays))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{folder}: expected a case as `splatpainter bench` keeps it ({error})") from None

    @staticmethod
    def digest(folder: Path) -> str:
        """Digest of a saved case: 16 hex digits."""
        return _sha((folder / "case.json").read_bytes() + (folder / "case.npz").read_bytes())


def _case(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> Case:
    def images(name: str) -> PosedImages:
        cameras = tuple(Camera.from_json(c) for c in values["cameras"][name])
        return PosedImages(cameras, arrays[name].astype(np.float32))

    steps = []
    for k, step in enumerate(values["steps"]):
        edited = images(f"step{k}")
        masks = np.unpackbits(arrays[f"step{k}_masks"], axis=-1, count=edited.colors.shape[2]).astype(bool)
        steps.append(EditStep(step["mode"], step["kind"], edited, masks))
    attributes: dict[str, Any] = {name: arrays[f"asset_{name}"] for name in ATTRIBUTES}
    return Case(
        protocol=values["protocol"],
        name=values["name"],
        label=values["label"],
        asset=Splats(**attributes, antialiased=values["antialiased"], color_space=values["color_space"]),
        base=images("base"),
        steps=tuple(steps),
        before=images("before"),
        after=images("after"),
        near=arrays["near"],
        true_views=images("oracle") if "oracle" in values["cameras"] else None,
        setup_seconds=values["setup_seconds"],
        facts=values["facts"],
    )


@dataclass(frozen=True)
class Record:
    """One method on one case: a JSON file each, so that an interrupted run goes on where it was."""

    protocol: str
    """Name of the table."""
    method: str
    label: str
    """Label of the case."""
    name: str
    """Name of the object."""
    fingerprint: str
    """Fingerprint of case, method and budget (`fingerprint`): a record with another one is out of date."""
    error: str = ""
    """Why there are no figures: what the method raised, or how its process ended. "": it worked."""
    missing: str = ""
    """Why the method cannot run on this machine ("not installed: ..."); then there are no figures either."""
    figures: dict[str, float | None] = field(default_factory=dict)
    """Column key -> figure."""
    setup_seconds: float | None = None
    edit_seconds: float | None = None
    peak_mib: float | None = None
    """Largest resident memory of the method's process in this case; where the system cannot forget peaks, so far."""
    rows: int | None = None
    """Gaussians of the edited asset."""
    rows_equal: float | None = None
    """Share of the asset's Gaussians that kept their bits, 0..1; None for methods that make a new asset."""
    appended: int | None = None
    """Gaussians behind the asset's."""
    numbers: dict[str, float] = field(default_factory=dict)
    note: str = ""
    curve: list[dict[str, float | None]] = field(default_factory=list)
    """Points of quality against time: {"seconds", "steps", column keys ...}."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Facts of the case."""
    machine: str = ""

    @property
    def has_figures(self) -> bool:
        return not self.error and not self.missing

    def write(self, path: Path) -> None:
        _write_json(path, asdict(self))

    @staticmethod
    def read(path: Path) -> Record:
        """Raises ValueError for a file that is no record."""
        try:
            values = json.loads(files.read_all(path))
            return Record(**{f.name: values[f.name] for f in fields(Record)})
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected a record as `splatpainter bench` writes it ({error})") from None


def records(folder: Path) -> Iterator[Record]:
    """All records below OUT/TABLE, by method and label."""
    for path in sorted((folder / "records").glob("*/*.json")):
        yield Record.read(path)


def fingerprint(digest: str, version: str, budget: Budget, perceptual: bool) -> str:
    """Fingerprint of a record: digest of its case, and 16 hex digits of what else decides its figures: the method's
    version, the budget, whether LPIPS was measured."""
    values = [version, budget.steps, budget.device, budget.seed, budget.curve, perceptual]
    return f"{digest}-{_sha(json.dumps(values).encode())}"


@dataclass(frozen=True)
class CaseStore:
    """Cases and records of one table in OUT/TABLE. Makes none."""

    out: Path
    protocol: str
    """Name of the table."""

    @property
    def folder(self) -> Path:
        return self.out / self.protocol

    @property
    def logs(self) -> Path:
        return self.folder / "logs"

    def case_folder(self, label: str) -> Path:
        return self.folder / "cases" / label

    def record_path(self, method: str, label: str) -> Path:
        return self.folder / "records" / method / f"{label}.json"

    def claim(self, setup: Setup, redo: Redo, earlier: Path) -> None:
        """Note the setup that the folder's cases are of. earlier: a file whose "setup" counts where none was noted.

        Raises ValueError where it holds those of another one, unless all is to be made again: hours of path tracing
        are not to be lost by a word. Numbers of objects and locations of files may differ."""
        noted: dict[str, Any] = {}
        path, new = self.folder / "setup.json", to_json(setup)
        for file, inside in ((earlier, True), (path, False)):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                values = json.loads(file.read_bytes())
                noted = dict(values["setup"] if inside else values)
        compared = [name for name in new if name in noted and name not in ("objects", "names", *DATA_FOLDERS)]
        changes = [f"{name} {noted[name]}, not {new[name]}" for name in compared if noted[name] != new[name]]
        if changes and redo != "all":
            raise ValueError(
                f"bench {self.protocol}: {self.folder} holds cases of another setup ({'; '.join(changes)}); "
                "take another --out, or --redo all to make them anew"
            )
        _write_json(path, new)

    def stamp(self, key: CaseKey, setup: Setup) -> str:
        """16 hex digits that change whenever the case may: table, key, setup, and the files that it is made from.

        Folders count by what is in them, not by where they are, so that machines that fill one folder may keep their
        data in different places; of the objects only the case's files count, so that a grown folder, or asking for
        more objects, makes no case anew."""
        values: dict[str, Any] = asdict(setup)
        for which in ("objects", "names"):
            values.pop(which)
        for folder in DATA_FOLDERS[1:]:
            values[folder] = _digest(_listing(values[folder]))
        listing = _listing(values["data"])
        of_object = [line for line in listing if key.name in _object_names(line[0])]
        values["data"] = _digest(of_object or listing)
        stamped = {"version": VERSION, "protocol": self.protocol, "setup": values, "key": asdict(key)}
        return _sha(json.dumps(stamped, sort_keys=True, default=str).encode())

    def has(self, key: CaseKey, setup: Setup) -> bool:
        """Whether the case is there, complete, as the setup wants it."""
        folder = self.case_folder(key.label)
        try:
            values = json.loads((folder / "stamp.json").read_bytes())
            complete = (folder / "case.json").is_file() and (folder / "case.npz").is_file()
            return complete and values["stamp"] == self.stamp(key, setup)
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def save(self, case: Case, stamp: str, pictures: dict[str, Any]) -> None:
        """Write a case and its pictures; the stamp comes last, so that what was interrupted counts as not made.

        pictures: BenchTable.pictures of the unedited asset: "result", and "truth" where the table says what to compare
        it with; otherwise the truth is the most changed view."""
        folder = self.case_folder(case.label)
        (folder / "stamp.json").unlink(missing_ok=True)
        case.save(folder)
        write_png(folder / "input.png", case.steps[-1].edited.colors[0])
        write_png(folder / "before.png", np.asarray(pictures["result"]))
        view = case.most_changed_view
        if "truth" in pictures:
            write_png(folder / "truth.png", np.asarray(pictures["truth"]))
        elif view is not None:
            write_png(folder / "truth.png", case.after.colors[view])
        self._failure(case.label).unlink(missing_ok=True)
        _write_json(folder / "stamp.json", {"stamp": stamp, "name": case.name, "facts": case.facts})

    def load(self, label: str) -> Case:
        return Case.load(self.case_folder(label))

    def describe(self, label: str) -> tuple[str, dict[str, Any]]:
        """(name of the object, facts) of a case that is there, without reading its pictures."""
        values = json.loads((self.case_folder(label) / "stamp.json").read_bytes())
        return values["name"], values["facts"]

    def digest(self, label: str) -> str:
        """Digest of a case that is there: 16 hex digits, as Case.digest."""
        return Case.digest(self.case_folder(label))

    def save_failure(self, label: str, name: str, reason: str) -> None:
        """Note that a case could not be made."""
        _write_json(self._failure(label), {"name": name, "reason": reason})

    def failures(self, labels: Iterable[str]) -> dict[str, tuple[str, str]]:
        """Label -> (name of the object, reason) of those that could not be made."""
        reasons = {}
        for label in labels:
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                values = json.loads(self._failure(label).read_bytes())
                reasons[label] = (str(values["name"]), str(values["reason"]))
        return reasons

    def save_record(self, record: Record) -> None:
        """A record without figures; the picture of an older one goes."""
        path = self.record_path(record.method, record.label)
        path.with_suffix(".png").unlink(missing_ok=True)
        record.write(path)

    def is_current(self, blank: Record, redo: Redo) -> bool:
        """Whether there is a record like `blank` that need not be made anew."""
        path = self.record_path(blank.method, blank.label)
        if redo == "all" or not path.exists():
            return False
        try:
            record = Record.read(path)
        except ValueError:
            return False
        usable = record.has_figures or (redo == "nothing" and not record.missing)
        return usable and record.fingerprint == blank.fingerprint

    def _failure(self, label: str) -> Path:
        return self.folder / "failed" / f"{label}.json"


def safe(name: str) -> str:
    """A file name for an object or light: itself where it is one, else with a digest that keeps it apart."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._")
    if plain == name and len(name) <= MAX_NAME_CHARS:
        return name
    return f"{plain[:64]}-{hashlib.sha256(name.encode()).hexdigest()[:6]}"


@lru_cache(maxsize=16)
def _listing(folder: Path | None) -> tuple[tuple[str, int], ...]:
    """(relative name, bytes) of every file below a folder; once per process."""
    if folder is None:
        return ()
    listed = [file for file in Path(folder).rglob("*") if file.is_file()]
    return tuple(sorted((file.relative_to(folder).as_posix(), file.stat().st_size) for file in listed))


def _object_names(file: str) -> tuple[str, ...]:
    """What an object in this file (relative) may be called."""
    path = Path(file)
    stem = path.with_suffix("").as_posix()
    return stem, safe(stem), path.name, safe(path.name)


def _digest(listing: Iterable[tuple[str, int]]) -> str:
    return _sha("\n".join(f"{size} {name}" for name, size in listing).encode())


def _sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _write_json(path: Path, values: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.writing(path) as file:
        file.write(json.dumps(values, indent=1).encode())
