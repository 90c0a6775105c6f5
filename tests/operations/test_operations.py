"""Operations as values, and lists of them on files: each option once, one receipt, the same as one after the other."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter import receipts
from splatpainter.commands.edit import split_words
from splatpainter.io.formats import ply
from splatpainter.operations import to_file
from splatpainter.operations.operation import Operation, Wording, kinds, operation_class, operation_of
from splatpainter.operations.to_file import apply_to_file
from splatpainter.painter import Asset
from splatpainter.splats import rows_sha256
from splatpainter.surface.estimate import Surface
from tests.support.cli_scenes import BOX, Capture, ball, listing, paint, run, saved

HERE = Path("c.json")
CHOSEN: dict[str, Operation] = {
    "paint": sp.Paint((Path("a.png"), Path("b.png")), cameras=(HERE, HERE), mode="global", method="lift"),
    "decal": sp.LayDecal(text="No. 7", at=(3, 4.5), camera=HERE, width="12%", angle_limit=0.0),
    "grade": sp.Grade(exposure=0.5, where=("y=..0", "x=0..")),
    "fill": sp.Fill(around=("sphere=0,0,0,1",), source="command", options={"run": "x"}),
    "refine": sp.Refine(views=(HERE,), scale=4),
    "generate": sp.Generate(source="command", prompt="moss", views="auto", references=(Path("r.png"),)),
    "light": sp.Relight(sun=("30,40",), mix=0.5),
    "delight": sp.Delight(shadows=False),
    "pixelate": sp.Pixelate(("x=0..",), size=0.2, merge=True),
    "replay": sp.ReplayLayers(Path("p.splatproj"), only=("stripe",), asset="2"),
}


@pytest.fixture
def folder(tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> Path:
    """ball.ply, views/view_000.png and painted.png, in the current folder."""
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "ball.ply", ball(900))
    assert run(capfd, "render", "ball.ply", "--out", "views", "--views", 1, "--size", 96).code == 0
    paint(tmp_path / "views" / "view_000.png", tmp_path / "painted.png", BOX)
    return tmp_path


@pytest.mark.parametrize("kind", kinds())
def test_a_value_is_json_and_python_and_comes_back(kind: str) -> None:
    """Names of files and lists may be given for paths and tuples."""
    operation = CHOSEN[kind]
    assert type(operation)(**{name: list(v) if isinstance(v, tuple) else v for name, v in vars(operation).items()}) == (
        operation
    )
    assert operation.kind == kind and type(operation) is operation_class(kind)
    operation.check()
    assert operation_of(json.loads(json.dumps(operation.record())), "x") == operation
    assert eval(operation.python(), {"sp": sp}) == operation
    assert dataclasses.replace(operation) == operation and operation_class(kind)().changes() == {}
    assert all(isinstance(path, Path) for path in operation.files())


@pytest.mark.parametrize(
    "record, words",
    [
        ({"kind": "grade"}, "x: expected sliders or one look"),
        ({"kind": "grade", "exposure": "warm"}, "x: expected float as 'exposure', got 'warm'"),
        ({"kind": "grade", "exposition": 1}, "x: unknown key 'exposition'; known there: exposure"),
        ({"kind": "grde"}, "expected an operation of paint, decal, grade"),
        ({}, "x: expected an operation with its kind, got an object of 0"),
        ({"kind": "pixelate"}, "x: expected where, the region"),
        ({"kind": "decal", "at": [1]}, "x: expected 2 values as 'at', got a list of 1"),
    ],
)
def test_json_that_is_no_operation_is_one_line(record: dict, words: str) -> None:
    with pytest.raises(ValueError, match=r"\A[^\n]*\Z") as error:
        operation_of(record, "x")
    assert str(error.value).startswith(words)


def test_a_list_is_its_operations_one_after_the_other(folder: Path, capfd: Capture) -> None:
    words = ["paint", "painted.png", "grade", "--exposure", "0.3", "--where", "y=..0"]
    done = run(capfd, "edit", "ball.ply", *words, "--out", "list.ply", "--json")
    assert done.code == 0, done.err
    assert run(capfd, "edit", "ball.ply", "painted.png", "--out", "one.ply").code == 0
    assert run(capfd, "grade", "one.ply", "--exposure", 0.3, "--where", "y=..0", "--out", "two.ply").code == 0
    assert (folder / "list.ply").read_bytes() == (folder / "two.ply").read_bytes()
    receipt = done.json["receipt"]
    assert receipt["mode"] == "operations" and [entry["kind"] for entry in receipt["operations"]] == ["paint", "grade"]
    assert receipt["operations"][1]["note"] == "exposure 0.3; where y=..0" and len(receipt["views"]) == 1
    assert run(capfd, "verify", "ball.ply", "list.ply").code == 0
    before, after = sp.read("ball.ply"), sp.read("list.ply")
    touched = np.flatnonzero((before.sh != after.sh[: len(before)]).any((1, 2)))
    assert len(touched) <= receipt["touched_rows"] < len(before)


def test_the_same_list_everywhere(folder: Path, capfd: Capture) -> None:
    operations = [sp.Paint((Path("painted.png"),)), sp.Grade(saturation=-0.5)]
    done = apply_to_file(Path("ball.ply"), operations, Path("python.ply"))
    assert done.verification.ok and [step.operation for step in done.steps] == operations
    words = ["painted.png", "grade", "--saturation", -0.5]  # pictures first need no name
    assert run(capfd, "edit", "ball.ply", *words, "--out", "words.ply").code == 0
    assert (folder / "python.ply").read_bytes() == (folder / "words.ply").read_bytes()
    asset = sp.edit(sp.read("ball.ply"), operations)
    sp.write("memory.ply", asset.splats)
    assert (folder / "python.ply").read_bytes() == (folder / "memory.ply").read_bytes()
    assert asset.receipt is not None and sp.verify("ball.ply", "memory.ply", asset.receipt).ok
    jobs = "assets: [ball.ply]\nedits:\n  - paint: {pictures: [painted.png]}\n  - grade: {saturation: -0.5}\n"
    (folder / "jobs.yaml").write_text(jobs)
    assert run(capfd, "batch", "jobs.yaml").code == 0
    assert (folder / "python.ply").read_bytes() == (folder / "out" / "ball.ply").read_bytes()


def test_idle_memory_goes_back_before_the_file_is_read_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The heap of the edit and what is read for the proof are never there together."""
    order: list[str] = []
    for module, name in ((to_file, "write"), (to_file, "return_idle_memory"), (receipts, "read")):
        before = getattr(module, name)

        def noted(*args: Any, _before: Any = before, _name: str = name, **kwargs: Any) -> Any:
            order.append(_name)
            return _before(*args, **kwargs)

        monkeypatch.setattr(module, name, noted)
    assert apply_to_file(Path("ball.ply"), [sp.Paint((Path("painted.png"),))], Path("out.ply")).verification.ok
    assert order == ["write", "return_idle_memory", "read"]


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_surface_is_made_once_beside_the_pictures(
    threads: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", str(threads))
    makers: list[str] = []
    before = Surface.of

    def noted(splats: sp.Splats) -> Surface:
        makers.append(threading.current_thread().name)
        return before(splats)

    monkeypatch.setattr(Surface, "of", noted)
    edited = sp.Paint((Path("painted.png"),)).apply(Asset(sp.read("ball.ply")))
    assert makers == [threading.current_thread().name if threads == 1 else "splatpainter beside"]
    monkeypatch.setenv("SPLATPAINTER_THREADS", "1")
    alone = sp.Paint((Path("painted.png"),)).apply(Asset(sp.read("ball.ply")))
    assert rows_sha256(edited.splats) == rows_sha256(alone.splats)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_files_are_hashed_beside_other_work(threads: int, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that is read while its pictures are looked at, the one that is written while its rows are compared."""
    monkeypatch.setenv("SPLATPAINTER_THREADS", str(threads))
    hashers: list[str] = []
    before = ply._sha256

    def noted(record: ply.PlyFile) -> str:
        hashers.append(threading.current_thread().name)
        return before(record)

    monkeypatch.setattr(ply, "_sha256", noted)
    done = apply_to_file(Path("ball.ply"), [sp.Paint((Path("painted.png"),))], Path("out.ply"))
    assert set(hashers[:2]) == {threading.current_thread().name if threads == 1 else "splatpainter beside"}
    sums = [hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in ("ball.ply", "out.ply")]
    assert sums == [done.receipt.asset_sha256, done.receipt.output_sha256]


def test_pictures_decals_and_operations_in_one_call(folder: Path) -> None:
    splats, camera = sp.read("ball.ply"), sp.Camera.from_json((folder / "views" / "view_000.json").read_text())
    picture = sp.render(splats, camera).colors[0].copy()
    picture[40:50, 40:56] = (0.1, 0.6, 0.2)
    decal = sp.Decal(np.full((8, 16, 3), 0.9), (48.0, 60.0), camera, "15%")
    asset = sp.edit(splats, [(picture, camera), decal, sp.Grade(exposure=0.2)], preset="lift")
    assert asset.receipt is not None
    assert [entry["kind"] for entry in asset.receipt.operations] == ["paint", "decal", "grade"]
    by_hand = sp.Grade(exposure=0.2).apply(sp.edit(sp.edit(splats, [(picture, camera)], preset="lift"), [decal]))
    assert np.array_equal(asset.splats.sh, by_hand.splats.sh)


def test_the_older_spellings_mean_the_same(folder: Path, capfd: Capture) -> None:
    at = ["--at", "48,48", "--camera", "views/view_000.json", "--width", "20%"]
    for number, words in enumerate((["--decal-text", "A"], ["decal", "--text", "A"])):
        assert run(capfd, "edit", "ball.ply", *words, *at, "--out", f"{number}.ply").code == 0
    assert run(capfd, "decal", "ball.ply", "--text", "A", *at, "--out", "2.ply").code == 0
    assert (folder / "0.ply").read_bytes() == (folder / "1.ply").read_bytes() == (folder / "2.ply").read_bytes()


@pytest.mark.parametrize(
    "words, line",
    [
        ("grade", "edit grade: expected sliders or one look (--exposure, "),
        ("grade --exposure 99", "edit grade: expected --exposure from -10 to 10, got 99.0"),
        (
            "grade --exposre 1",
            "edit grade: unknown option --exposre; perhaps you meant --exposure; see splat",
        ),
        ("grade --exposure 1 fill", "edit fill: expected --where (what to remove) or --around"),
        ("decal --text A --at 1,1 --width 3", "edit decal: a decal needs one --camera CAM.json, in whose picture --at"),
        ("decal", "edit decal: expected PICTURE or --text, got none"),
        ("painted.png paint --mode global", "edit paint: expected 1 to 16 pictures (VIEW.png) after ASSET, got none"),
        ("generate --prompt moss", "edit generate: expected --source NAME"),
        ("pixelate --where x=0.. --size 0", ": decal: expected a width above 0"),
        ("grade --exposure 1 --json --out y.ply", "edit: --out was given twice"),
        ("grade --exposure 1 paint nothing.png", ": nothing.png: no such file"),
        ("grade --exposure 1 generate --source command --dry-run", ": source command: needs the option run"),
        ("grade --exposure 1 --dry-run", "edit grade: --dry-run is for pictures that a source makes"),
    ],
)
def test_what_is_wrong_is_one_line_before_anything_is_done(folder: Path, capfd: Capture, words: str, line: str) -> None:
    before = listing(folder)
    done = run(capfd, "edit", "ball.ply", *words.split(), "--out", "x.ply")
    expected = f"splatpainter {line}" if line.startswith("edit") else f"splatpainter{line}"
    assert done.error.startswith(expected), done.err
    assert listing(folder) == before


def test_words_are_split_at_the_names_of_operations() -> None:
    files, segments = split_words(
        "--json a.ply v.png --mode global decal --text fill --at 1,2 grade --where x=0.. light --no-shadows paint "
        "./paint --out=b.ply --axes rub".split()
    )
    assert files == ["--json", "a.ply", "--out=b.ply", "--axes", "rub"]
    assert [(segment.kind, *segment.words) for segment in segments] == [
        ("paint", "v.png", "--mode", "global"),
        ("decal", "--text", "fill", "--at", "1,2"),
        ("grade", "--where", "x=0.."),
        ("light", "--no-shadows"),
        ("paint", "./paint"),
    ]
    assert [segment.is_named for segment in segments] == [False, True, True, True, True]
    assert split_words(["paint", "v.png"]) == (["paint"], split_words(["a", "v.png"])[1]), "ASSET may be called so"


def test_edit_has_few_options_of_its_own() -> None:
    from splatpainter.commands.edit import Arguments

    assert len(dataclasses.fields(Arguments)) - 1 <= 8, "ASSET is none"


def test_an_operation_of_another_distribution(monkeypatch: pytest.MonkeyPatch, folder: Path, capfd: Capture) -> None:
    """By an entry point: in the list, in help, in JSON."""

    @dataclasses.dataclass(frozen=True)
    class Darken(sp.Grade):
        """Make an asset darker."""

        kind = "darken"
        stops: float = 1.0
        """How much."""

        def ready(self, tools):
            return sp.Grade(exposure=-self.stops).ready(tools)

        def check(self, wording: Wording = Wording()) -> None:  # noqa: B008
            assert self.stops

    class Point:
        name = "darken"

        @staticmethod
        def load() -> type[Operation]:
            return Darken

    monkeypatch.setattr("splatpainter.operations.operation._entry_points", lambda: [Point])
    assert run(capfd, "edit", "ball.ply", "darken", "--stops", 0.5, "--out", "dark.ply").code == 0
    assert run(capfd, "grade", "ball.ply", "--exposure", -0.5, "--out", "same.ply").code == 0
    assert (folder / "dark.ply").read_bytes() == (folder / "same.ply").read_bytes()
    assert operation_of({"kind": "darken", "stops": 2}, "x") == Darken(stops=2.0)


def test_an_asset_that_was_edited_goes_on(folder: Path) -> None:
    first = sp.edit(sp.read("ball.ply"), [sp.Grade(exposure=0.2)])
    second = sp.edit(first, [sp.Grade(exposure=0.1), sp.Delight(mix=0.5)])
    assert isinstance(second, Asset) and second.receipt is not None
    assert second.receipt.asset_sha256 == first.splats.sha256 and len(second.receipt.operations) == 2


def test_a_lossy_picture_that_is_another_all_over_is_warned_of(folder: Path, capfd: Capture) -> None:
    """Somebody may have had all of it made anew; more often a service gave back a poor copy."""
    with Image.open(folder / "painted.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(np.float32)
    noisy = pixels + np.random.default_rng(0).normal(0, 9, pixels.shape)
    Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).save(folder / "noisy.webp", quality=80)
    words = ("edit", "ball.ply", "noisy.webp", "--camera", "views/view_000.png", "--method", "lift")
    done = run(capfd, *words, "--out", "o.ply")
    assert done.code == 0 and "noisy.webp: more than its compression changed all of it" in done.err
    Image.fromarray(pixels.astype(np.uint8)).save(folder / "good.webp", quality=80)
    done = run(capfd, *words[:2], "good.webp", *words[3:], "--out", "g.ply")
    assert done.code == 0 and "compression changed" not in done.err
