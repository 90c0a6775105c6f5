"""Training data by name: `procedural:N`, a folder of meshes or splats, or a folder of shards; training and validation
kept apart by object. Knows no model."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splattrain.data.held_out import HeldOut
from splattrain.data.object_sources import SPLAT_SUFFIXES, MeshFolder, ProceduralSource, SplatFolder
from splattrain.data.samples import SampleRecipe, SampleStream
from splattrain.data.shards import INDEX, ShardStream, read_index
from splattrain.prefetch import PrefetchedSamples

if TYPE_CHECKING:
    from splattrain.data.gaussian_edits import GaussianEditStream
    from splattrain.data.painted_gaussians import PaintedEdit, PaintedGaussianStream
    from splattrain.data.samples import Sample

VALIDATION_SEED = 0x5EED
"""Added to the recipe's seed for what validation draws: procedural objects of another seed, and other edits."""


@dataclass(frozen=True)
class ResourceFolders:
    """Folders of things that edits and lights are made of; None: built-in ones."""

    environments: Path | None = None
    """HDRIs, .hdr or .exr."""
    decals: Path | None = None
    """PNGs with transparency."""
    fonts: Path | None = None
    """.ttf or .otf."""
    textures: Path | None = None
    """Photos."""


@dataclass(frozen=True)
class TrainingData:
    """What a run trains on."""

    training: Any
    """[i] -> Sample, endless."""
    validation: list[Any]
    """Fixed; samples, of stage predict edits of Gaussians without pictures."""
    objects: tuple[int, int]
    """Numbers of objects for training and for validation."""


@dataclass(frozen=True)
class DataSettings:
    """Where samples come from; small, so that it can be sent to other processes."""

    data: str
    recipe: SampleRecipe
    seed: int
    """Seed of order and edits."""
    share: float
    """Share of the objects that is for validation."""
    resources: ResourceFolders
    device: str = "cpu"
    memory: int = 1 << 30
    """Bytes of objects that a stream keeps."""
    names: tuple[str, ...] = ()
    """Objects that are for validation, by name, in place of a share; of folders and shards only."""

    @property
    def held_out(self) -> HeldOut:
        """Which objects are for validation."""
        return HeldOut(self.share, self.names)

    def stream(self, *, validation: bool = False) -> Any:
        """The samples of the training objects, or of those held back: another seed, an object of its own each. None
        where there are none of these. Raises ValueError: nothing there, too few objects, files that are not there."""
        recipe, seed = self.recipe, self.seed
        if validation:
            recipe, seed = dataclasses.replace(recipe, steps_per_object=1), seed + VALIDATION_SEED
        if is_shards(self.data):
            names = _shard_names(self.data, self.held_out)[validation]
            kinds = [kind for kind, weight in recipe.kinds.items() if weight > 0]
            return ShardStream(self.data, seed, names=names, kinds=kinds) if names else None
        source = _sources(self.data, self.seed, self.held_out, self.resources)[validation]
        if source is None:
            return None
        return SampleStream(source, recipe, seed, **_files(self.resources), device=self.device, cache_bytes=self.memory)

    def counts(self) -> tuple[int, int]:
        """Objects of training and of validation."""
        if is_shards(self.data):
            train, validation = _shard_names(self.data, self.held_out)
            return len(train), len(validation)
        train, validation = _sources(self.data, self.seed, self.held_out, self.resources)
        return len(train), len(validation) if validation is not None else 0


class Lanes:
    """Streams of the same settings, one per lane of a batch (loop.sample_numbers): each stays on its own object."""

    def __init__(self, settings: DataSettings, count: int) -> None:
        self._settings, self._count = settings, count
        self._streams: dict[int, Any] = {}

    def __getitem__(self, i: int) -> Sample:
        lane = i // self._settings.recipe.steps_per_object % self._count
        if lane not in self._streams:
            self._streams[lane] = self._settings.stream()
        return self._streams[lane][i]


def open_global_edits(settings: DataSettings, count: int) -> TrainingData:
    """As `open_training_data`, for stage predict, whose samples have no pictures (data/global_edits.py). Raises
    ValueError as DataSettings.stream and GlobalEditStream."""
    from splattrain.data.global_edits import GlobalEditStream

    if is_shards(settings.data):
        raise ValueError(f"--data {settings.data}: expected meshes or procedural:N for stage predict, got shards")
    few = dataclasses.replace(settings, memory=settings.memory >> 4)
    validation = few.stream(validation=True) if count else None
    samples = [] if validation is None else list(_first(GlobalEditStream(validation, 0), count))
    return TrainingData(GlobalEditStream(few.stream(), cache_bytes=settings.memory), samples, settings.counts())


def open_gaussian_edits(settings: DataSettings, count: int, folder: Path | None, fitted: bool = True) -> TrainingData:
    """As `open_training_data`, for stage rows, whose samples have no pictures (data/gaussian_edits.py). Raises
    ValueError as gaussian_edit_streams."""
    training, held_out = gaussian_edit_streams(settings, folder, fitted)
    return TrainingData(training, list(_first(held_out, count)) if count and held_out else [], settings.counts())


def gaussian_edit_streams(
    settings: DataSettings, folder: Path | None, fitted: bool = True
) -> tuple[GaussianEditStream, GaussianEditStream | None]:
    """(edits of training objects, of those held back, None where there are none). folder: where assets are kept;
    fitted: of 3DGS, too. Raises ValueError as DataSettings.stream and GaussianEditStream, and for splat assets."""
    from splattrain.data.environments import load_environment
    from splattrain.data.gaussian_edits import EDIT_KINDS, GaussianEditStream
    from splattrain.data.lit_assets import LitAssets

    if is_shards(settings.data):
        raise ValueError(f"--data {settings.data}: expected meshes or procedural:N for stage rows, got shards")
    sources = _sources(settings.data, settings.seed, settings.held_out, settings.resources)
    lights = tuple(load_environment(f) for f in _listed(settings.resources.environments, (".hdr", ".exr")))
    kinds = {kind: settings.recipe.kinds.get(kind, 0.0) for kind in EDIT_KINDS}
    streams = []
    for source, seed in zip(sources, (settings.seed, settings.seed + VALIDATION_SEED), strict=True):
        if source is not None and not hasattr(source, "mesh"):
            raise ValueError(f"--data {settings.data}: expected meshes, whose materials are known, got splat assets")
        if source is None:
            continue
        assets = LitAssets(source, settings.recipe, 0, lights, folder, settings.memory)
        samples_per_object = 1 if streams else settings.recipe.steps_per_object
        streams.append(
            GaussianEditStream(assets, kinds, ("coarse", "fitted") if fitted else ("coarse",), seed, samples_per_object)
        )
    return streams[0], streams[1] if len(streams) > 1 else None


def open_painted_gaussians(settings: DataSettings, count: int, folder: Path | None, edits: int) -> TrainingData:
    """As `open_training_data`, for stage rows with pictures as the carrier (data/painted_gaussians.py). folder: where
    edits are kept; edits: how many are drawn of the training objects; of the others, whole ones. Raises ValueError as
    DataSettings.stream and PaintedGaussianStream, and for splat assets."""
    training, held_out = painted_gaussian_streams(settings, folder, edits)
    samples = list(_first(FullEdits(held_out), count)) if count and held_out is not None else []
    return TrainingData(training, samples, settings.counts())


def painted_gaussian_streams(
    settings: DataSettings, folder: Path | None, edits: int
) -> tuple[PaintedGaussianStream, PaintedGaussianStream | None]:
    """(edits of training objects, of those held back, None where there are none). Raises ValueError as
    `open_painted_gaussians`."""
    from splattrain.data.edits.content import EditResources
    from splattrain.data.painted_gaussians import PaintedGaussianStream

    if is_shards(settings.data):
        raise ValueError(f"--data {settings.data}: expected meshes or procedural:N for stage rows, got shards")
    sources = _sources(settings.data, settings.seed, settings.held_out, settings.resources)
    files = _files(settings.resources)
    lights = files.pop("environments")
    resources = EditResources(**{name: tuple(part) for name, part in files.items()})
    streams: list[PaintedGaussianStream] = []
    for source, seed in zip(sources, (settings.seed, settings.seed + VALIDATION_SEED), strict=True):
        if source is None:
            continue
        if not hasattr(source, "mesh"):
            raise ValueError(f"--data {settings.data}: expected meshes, whose truth is known, got splat assets")
        recipe = dataclasses.replace(settings.recipe, steps_per_object=1) if streams else settings.recipe
        cache = None if streams else folder
        streams.append(PaintedGaussianStream(source, recipe, seed, lights, resources, cache, edits))
    return streams[0], streams[1] if len(streams) > 1 else None


class FullEdits:
    """The edits of a stream with everything around them."""

    def __init__(self, stream: PaintedGaussianStream) -> None:
        self.stream = stream

    def __getitem__(self, i: int) -> PaintedEdit:
        return self.stream.full_edit(i)


def open_training_data(settings: DataSettings, *, batch: int, count: int, workers: int = 0) -> TrainingData:
    """Training samples for batches of this size, and `count` validation samples (0: none are made). workers: processes
    that make samples ahead. Raises ValueError as DataSettings.stream."""
    objects = settings.counts()
    if is_shards(settings.data):
        settings.stream()  # whether they hold samples of these kinds is told before the first step
    settings = dataclasses.replace(settings, memory=settings.memory // max(batch, 1))
    stream = settings.stream(validation=True) if count else None
    samples = [] if stream is None else list(_first(stream, count))
    samples_per_object = settings.recipe.steps_per_object
    if workers:
        make = partial(Lanes, dataclasses.replace(settings, device="cpu"), batch)
        return TrainingData(PrefetchedSamples(make, workers, samples_per_object), samples, objects)
    return TrainingData(Lanes(settings, batch), samples, objects)


def is_shards(data: str) -> bool:
    """Whether this is a folder of shards (`data render`)."""
    return (Path(data) / INDEX).is_file()


def _shard_names(data: str, held_out: HeldOut) -> tuple[list[str], list[str]]:
    """(training, validation) objects of a folder of shards."""
    scenes = [scene for shard in read_index(Path(data))["shards"] for scene in shard["scenes"]]
    return held_out.split(list(dict.fromkeys(scene["object"] for scene in scenes)), f"--data {data}")


def check_pictures(data: str, recipe: SampleRecipe, views: int, size: int) -> None:
    """Raises ValueError where the samples have fewer pictures of the unedited object than the model reads, or smaller
    or larger ones. views: of the model, size: pixels of their edges. Of shards their index tells, of objects the
    recipe."""
    count, pixels, give = recipe.base_views, recipe.size, "give --samples.base-views {} --samples.size {}"
    if is_shards(data):
        spec = read_index(Path(data)).get("spec", {}).get("recipe", {})
        count, pixels = int(spec.get("base_views", views)), int(spec.get("size", size))
        give = "render shards with data render --base-views {} --size {}"
    if count < views or pixels != size:
        raise ValueError(
            f"--data {data}: expected samples of {views} base views or more of {size} px, which the model reads, got "
            f"{count} of {pixels} px; {give.format(max(count, views), size)}"
        )


def _first(stream: Any, count: int) -> Iterator[Sample]:
    """The first `count` samples that can be made, of twice as many numbers."""
    yielded, last = 0, "no object"
    for i in range(2 * count):
        if yielded == count:
            return
        try:
            yield stream[i]
        except ValueError as error:
            last = str(error)
            continue
        yielded += 1
    if not yielded:
        raise ValueError(f"validation: no sample could be made; the last problem: {last}")


def _sources(data: str, seed: int, held_out: HeldOut, resources: ResourceFolders) -> tuple[Any, Any]:
    """(training, validation) objects; validation None where there are too few to spare any."""
    if data.startswith("procedural:"):
        number = data.removeprefix("procedural:")
        if not number.isdigit() or int(number) < 1:
            raise ValueError(f"--data {data}: expected procedural:N with a number of objects, such as procedural:500")
        if held_out.names:
            raise ValueError(f"--data {data}: procedural objects have no list of names; leave --names out")
        count, share = int(number), held_out.share
        other = ProceduralSource(min(count, 64), seed + VALIDATION_SEED, resources.textures) if share > 0 else None
        return ProceduralSource(count, seed, resources.textures), other
    folder = Path(data)
    if not folder.is_dir():
        raise ValueError(f"--data {data}: expected procedural:N, or a folder of meshes, splats or shards")
    kind: Any = MeshFolder
    try:
        every: Any = MeshFolder(folder)
    except ValueError:
        if not any(f.suffix.lower() in SPLAT_SUFFIXES for f in folder.iterdir()):
            raise
        kind = SplatFolder
        every = SplatFolder(folder)
    # The split never depends on the run's seed: stages trained one after the other share their validation objects.
    names, validation = held_out.split([every.name(i) for i in range(len(every))], f"--data {data}")
    if not names:
        raise ValueError(f"--data {data}: expected at least one object to train on, got {len(every)} in all")
    return kind(folder, names), kind(folder, validation) if validation else None


def _files(resources: ResourceFolders) -> dict[str, Sequence[Any]]:
    from splattrain.data.environments import load_environment

    return {
        "environments": tuple(load_environment(f) for f in _listed(resources.environments, (".hdr", ".exr"))),
        "decals": tuple(_listed(resources.decals, (".png", ".webp"))),
        "fonts": tuple(_listed(resources.fonts, (".ttf", ".otf"))),
        "textures": tuple(_listed(resources.textures, (".png", ".jpg", ".jpeg", ".webp"))),
    }


def _listed(folder: Path | None, suffixes: tuple[str, ...]) -> list[Path]:
    if folder is None:
        return []
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    files = sorted(f for f in folder.rglob("*") if f.suffix.lower() in suffixes)
    if not files:
        raise ValueError(f"{folder}: holds no file that ends in {', '.join(suffixes)}")
    return files
