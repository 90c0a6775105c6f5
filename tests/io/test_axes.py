"""Which way a file's axes point: said, chosen, kept; and what splat-transform 2 and 3 make of SPZ files."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from splatpainter import io
from splatpainter.batch.plan import read_jobs
from splatpainter.io.axes import AXES, flip
from splatpainter.io.formats.spz import write_spz
from splatpainter.io.write_options import WriteOptions
from splatpainter.receipts import verify
from splatpainter.session import Session
from splatpainter.session.project.asset_files import write_original
from splatpainter.splats import Axes, Splats
from tests.support.cli_scenes import BOX, Capture, ball, paint, run
from tests.support.io_assets import disagreement, float_columns, random_splats
from tests.support.io_packed import alone, quats_apart, same_bits

if TYPE_CHECKING:
    from tests.support.node_oracle import SplatTransform

pytest_plugins = ["tests.support.node_oracle"]

AXES_CHOICES: tuple[Axes, ...] = ("rub", "rdf")
EVERY = ["a.ply", "a.compressed.ply", "a.splat", "a.spz", "a.sog", "a.glb"]
RECORD = 0xADBE0003


def axis_of(path: Path) -> int | None:
    """The axes that an SPZ file of version 4 names, without the package."""
    data = path.read_bytes()
    (table,) = struct.unpack_from("<I", data, 16)
    extensions = {kind: value for kind, _, value in struct.iter_unpack("<III", data[32:table])}
    return extensions.get(RECORD) if data[14] & 2 else None


def silent(path: Path) -> None:
    """Take the extensions out of an SPZ file of version 4, without the package."""
    data = bytearray(path.read_bytes())
    (table,) = struct.unpack_from("<I", data, 16)
    data[14] &= ~2
    struct.pack_into("<I", data, 16, 32)
    path.write_bytes(bytes(data[:32] + data[table:]))


def test_old_spellings_mean_the_same(tmp_path: Path, capfd: Capture) -> None:
    """What was called frame before: keywords and attributes of Python, options of commands, both in one command too."""
    old: dict[str, Any] = {"frame": "rub"}
    both: dict[str, Any] = {"frame": "rub", "out_frame": "rub"}
    path, edited = tmp_path / "a.spz", tmp_path / "b.spz"
    io.write(path, random_splats(20, 1), **old)
    splats = io.read(path, **old)
    assert splats.source is not None and splats.source.axes == splats.source.frame == "rub"
    assert splats.source.axes_from == splats.source.frame_from == "choice"
    io.write(edited, splats, **old)
    done = verify(path, edited, **both)
    assert done.ok and done.frame == done.axes and done.frame_is_news and done.axes.startswith("right-up-back")
    with Session(path, tmp_path / "a.splatproj", **old) as session:
        session.scene.add(path, **old)
        taken = [session.scene.original_of(asset.id).source for asset in session.scene.assets]
        assert [source and source.axes for source in taken] == ["rub", "rub"]
    with pytest.raises(TypeError, match="read: axes was given twice, also by its old name frame"):
        io.read(path, axes="rub", **old)
    (tmp_path / "JOBS.yaml").write_text("assets: [a.spz]\nframe: rub\nedits: [{grade: {exposure: 1}}]\n")
    assert [job.axes for job in read_jobs(tmp_path / "JOBS.yaml").jobs] == ["rub"]

    new = run(capfd, "convert", path, tmp_path / "new.ply", "--in-axes", "rub", "--axes", "rub")
    before = run(capfd, "convert", path, tmp_path / "old.ply", "--frame", "rub", "--out-frame=rub")
    assert (new.code, before.code) == (0, 0) and "axes: right-up-back, as chosen" in before.out
    assert (tmp_path / "new.ply").read_bytes() == (tmp_path / "old.ply").read_bytes()
    words = ("grade", path, "--out", tmp_path / "c.spz", "--exposure", "1", "--frame", "rub")
    assert "as chosen" in run(capfd, *words).out
    listed = run(capfd, "edit", path, "grade", "--exposure", "1", "--frame", "rub", "--out", tmp_path / "d.spz")
    assert listed.code == 0 and (tmp_path / "c.spz").read_bytes() == (tmp_path / "d.spz").read_bytes()
    assert "--in-axes was given twice" in run(capfd, *words, "--in-axes", "rub").error


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("axes", AXES_CHOICES)
def test_chosen_axes_are_kept_byte_for_byte(name: str, axes: Axes, tmp_path: Path) -> None:
    """Whatever was chosen: untouched assets are saved byte for byte, untouched rows of edited ones bit for bit."""
    io.write(tmp_path / name, random_splats(300, 1))
    splats = io.read(tmp_path / name, axes=axes)
    assert splats.source is not None and (splats.source.axes, splats.source.axes_from) == (axes, "choice")
    io.write(tmp_path / f"b{name}", splats)
    assert (tmp_path / f"b{name}").read_bytes() == (tmp_path / name).read_bytes()
    opacities = splats.opacities.copy()
    opacities[7] = 1 - opacities[7]
    edited = replace(splats, opacities=opacities)
    io.write(tmp_path / f"c{name}", edited)
    back = io.read(tmp_path / f"c{name}", axes=axes)
    rest = np.delete(np.arange(300), 7)
    assert same_bits(back, edited, rest) and np.abs(back.opacities - opacities).max() < 0.01
    verification = verify(tmp_path / name, tmp_path / f"c{name}", axes=axes)
    assert verification.ok and (verification.same, verification.changed) == (299, 1)
    assert verification.axes.startswith("right-up-back" if axes == "rub" else "right-down-front")


def test_axes_are_half_turns_of_each_other(tmp_path: Path) -> None:
    """rub is half a turn about x away from rdf, in every format; the reader's own axes are found again."""
    for name in EVERY:
        io.write(tmp_path / name, random_splats(60, 1))
        rub, rdf = (io.read(tmp_path / name, axes=axes) for axes in AXES_CHOICES)
        assert np.array_equal(rub.means, rdf.means * np.array([1, -1, -1], np.float32)), name
        natural = io.read(tmp_path / name)
        assert natural.source is not None and natural.source.axes == io.FORMATS[natural.source.format].axes
        signs = AXES[natural.source.axes]
        assert np.array_equal(natural.means, rdf.means * np.array(signs, np.float32)), name


def test_flips_restore_nan_bits() -> None:
    splats = random_splats(4, 2)
    splats.means.view(np.uint32)[0] = [0x7F800001, 0xFF800001, 0x80000000]  # signalling NaN, -NaN, -0
    for signs in ((1, -1, -1), (-1, -1, 1)):
        assert same_bits(flip(flip(splats, signs), signs), splats)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_new_spz_files_have_the_axes_of_ply_files(
    version: int, tmp_path: Path, spz_reference: Callable[[list[Path]], list[Splats]]
) -> None:
    """And do not say so, in every version; those of other axes say it, and any may be marked or not by choice. The
    reference implementation reads either marked way as the same asset."""
    splats = random_splats(200, 3)
    cases: dict[str, tuple[Axes, bool | None]] = {
        "auto": ("auto", None),
        "rdf": ("rdf", None),
        "rub": ("rub", None),
        "marked": ("rdf", True),
        "unmarked": ("rub", False),
    }
    for name, (axes, mark) in cases.items():
        write_spz(tmp_path / f"{name}.spz", splats, version, axes, mark=mark)
    rows = {name: io.read(tmp_path / f"{name}.spz") for name in cases}
    assert {name: s.source and (s.source.axes, s.source.axes_from) for name, s in rows.items()} == {
        "auto": ("rdf", "format"),
        "rdf": ("rdf", "format"),
        "rub": ("rub", "file"),
        "marked": ("rdf", "file"),
        "unmarked": ("rdf", "format"),  # as nothing says otherwise
    }
    assert (tmp_path / "auto.spz").read_bytes() == (tmp_path / "rdf.spz").read_bytes()
    turned = io.read(tmp_path / "unmarked.spz", axes="rub")
    for name, s in {**rows, "unmarked": turned}.items():
        assert np.array_equal(s.means, rows["auto"].means) and quats_apart(s.quats, splats.quats) < 0.15, name
    if version == 4:
        assert {name: axis_of(tmp_path / f"{name}.spz") for name in cases} == {
            "auto": None, "rdf": None, "rub": 4, "marked": 6, "unmarked": None
        }  # fmt: skip
    marked = ("rub", "marked")
    for name, truth in zip(marked, spz_reference([tmp_path / f"{name}.spz" for name in marked]), strict=True):
        assert np.array_equal(rows[name].means, truth.means)
        assert np.array_equal(rows[name].sh[:, 1:], truth.sh[:, 1:])


def test_positions_are_the_numbers_of_the_ply(tmp_path: Path) -> None:
    """Read by hand: the 24-bit words of a new file are the x, y, z of the PLY, and SH carry the same signs."""
    splats = replace(random_splats(3, 1), means=np.array([[0, 0.5, 0], [1, 0, 0], [0, 0, 2]], np.float32))
    splats.sh[:, 1:] = np.float32(0.5)
    splats.quats[:] = (0.9, 0.1, 0.2, 0.3)
    write_spz(tmp_path / "a.spz", splats, 3)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    bits, flags = data[13], data[14]
    words = np.frombuffer(data, np.uint8, 27, 16).reshape(9, 3).astype(int)
    fixed = (words * (1, 256, 65536)).sum(1)
    assert (fixed.reshape(3, 3) / 2**bits).tolist() == splats.means.tolist() and flags == 0
    assert set(data[16 + 3 * (9 + 1 + 3 + 3 + 4) :]) == {192}  # 0.5 of all nine bytes of SH, none turned, none behind


def test_marks_come_and_go_by_choice(tmp_path: Path, capfd: Capture) -> None:
    """`--axes` (once --out-frame) and `--mark-axes`; an unmarked copy of a marked file holds the same words."""
    io.write(tmp_path / "a.ply", random_splats(100, 1))
    for words, code in (((), None), (("--axes", "rub"), 4), (("--out-frame", "rub", "--mark-axes", "no"), None)):
        done = run(capfd, "convert", tmp_path / "a.ply", tmp_path / "b.spz", "--spz-version", 4, "--overwrite", *words)
        assert done.code == 0 and axis_of(tmp_path / "b.spz") == code, done
    run(capfd, "convert", tmp_path / "b.spz", tmp_path / "c.spz", "--in-axes", "rub", "--mark-axes", "yes")
    assert axis_of(tmp_path / "c.spz") == 4
    run(capfd, "convert", tmp_path / "c.spz", tmp_path / "d.spz", "--mark-axes", "no")
    assert (tmp_path / "d.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    turned = run(capfd, "convert", tmp_path / "c.spz", tmp_path / "e.spz", "--axes", "rdf")
    assert turned.code == 0 and axis_of(tmp_path / "e.spz") is None
    assert np.array_equal(io.read(tmp_path / "e.spz").means, io.read(tmp_path / "c.spz").means)
    assert (
        "mark_axes is not an option"
        in run(capfd, "convert", tmp_path / "a.ply", tmp_path / "f.glb", "--mark-axes", "no").error
    )


def test_an_edit_says_chosen_axes(tmp_path: Path) -> None:
    """A file that says nothing stays so where it was taken for what it would be taken for, and says it otherwise."""
    path = tmp_path / "a.spz"
    write_spz(path, random_splats(100, 1), 4)
    silent(path)
    cases: list[tuple[Axes, int | None]] = [("auto", None), ("rdf", None), ("rub", 4)]
    for axes, code in cases:
        splats = io.read(path, axes=axes)
        io.write(tmp_path / "b.spz", replace(splats, opacities=splats.opacities[::-1].copy()), overwrite=True)
        back = io.read(tmp_path / "b.spz")
        assert axis_of(tmp_path / "b.spz") == code
        assert same_bits(replace(back, opacities=splats.opacities), splats)
        verification = verify(path, tmp_path / "b.spz")  # only one of them says it: it counts for both
        assert verification.same + verification.changed == 100 and verification.changed <= 100
        assert ("right-up-back" in verification.axes) == (axes == "rub")
    wrong = io.read(tmp_path / "b.spz", axes="rdf")
    assert wrong.source is not None and "the file says right-up-back" in wrong.source.problems[0]
    (tmp_path / "b.spz").unlink()
    io.write(tmp_path / "b.spz", wrong)  # untouched: the file's own bytes, whatever they say
    assert axis_of(tmp_path / "b.spz") == 4


def test_other_axes_change_signs_alone(tmp_path: Path) -> None:
    """SPZ from one kind of axes into the other and back: the same words of position, colour, scale and opacity."""
    write_spz(tmp_path / "a.spz", random_splats(200, 2), 4)
    splats = io.read(tmp_path / "a.spz")
    io.write(tmp_path / "b.spz", splats, axes="rub")
    turned = io.read(tmp_path / "b.spz")
    assert axis_of(tmp_path / "b.spz") == 4
    for name in ("means", "scales", "opacities"):
        assert np.array_equal(getattr(turned, name), getattr(splats, name))
    assert np.abs(turned.sh - splats.sh).max() <= 1 / 128 and quats_apart(turned.quats, splats.quats) < 1e-6
    verification = verify(tmp_path / "a.spz", tmp_path / "b.spz")
    assert verification.same == 200 and "of the same axes" in verification.exact
    io.write(tmp_path / "c.spz", turned, axes="rdf")
    assert axis_of(tmp_path / "c.spz") is None  # turned to the PLY's axes: unmarked like any new file
    again = io.read(tmp_path / "c.spz")
    assert np.array_equal(again.means, splats.means)


def test_bytes_behind_the_rows_are_no_place_for_axes(tmp_path: Path) -> None:
    """Spark puts a tree there, under a flag of its own; a file with one cannot say its axes."""
    write_spz(tmp_path / "a.spz", random_splats(50, 0), 3)
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    data[14] = 0x80
    data += bytes(range(12))
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data)))
    splats = io.read(tmp_path / "a.spz", axes="rub")
    edited = replace(splats, opacities=splats.opacities[::-1].copy())
    io.write(tmp_path / "b.spz", edited)
    assert gzip.decompress((tmp_path / "b.spz").read_bytes())[-12:] == bytes(range(12))
    with pytest.raises(ValueError, match="c.spz: bytes behind its rows leave no room to mark its axes"):
        io.write(tmp_path / "c.spz", edited, options=WriteOptions(mark_axes=True))


def test_wrong_words(tmp_path: Path) -> None:
    splats = random_splats(5, 0)
    io.write(tmp_path / "a.ply", splats)
    wrong: Any = "up"
    with pytest.raises(ValueError, match="axes: expected one of auto, rub, rdf, got 'up'"):
        io.read(tmp_path / "a.ply", axes=wrong)
    with pytest.raises(ValueError, match="axes: expected one of auto, rub, rdf, got 'up'"):
        io.write(tmp_path / "b.ply", splats, axes=wrong)
    assert not (tmp_path / "b.ply").exists()


# ---- splat-transform: version 2 turns SPZ to right-up-back, version 3 leaves it right-down-front


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_files_of_theirs_are_upright_here(degree: int, tmp_path: Path, splat_transform: SplatTransform) -> None:
    """They say nothing of their axes; said by the caller, both versions' files are the asset they were made from."""
    oracle, axes = splat_transform, splat_transform.spz_axes
    truth = random_splats(300, degree)
    io.write(tmp_path / "a.ply", truth)
    oracle(tmp_path / "a.ply", tmp_path / "theirs.spz")
    silently = io.read(tmp_path / "theirs.spz")
    assert (
        silently.source is not None
        and silently.source.axes_from == "format"
        and axis_of(tmp_path / "theirs.spz") is None
    )
    splats = io.read(tmp_path / "theirs.spz", axes=axes)
    if axes == "rdf":  # version 3, the newest: no word is needed, and ours stands upright there as it is written
        assert np.array_equal(silently.means, splats.means)
        io.write(tmp_path / "ours.spz", truth)
        oracle(tmp_path / "ours.spz", tmp_path / "ours.ply")
        assert disagreement(truth, float_columns(tmp_path / "ours.ply"))["means"] < 1e-3
    nearest = np.argmin(((splats.means[:, None] - truth.means[None]) ** 2).sum(-1), 1)
    assert np.abs(splats.means - truth.means[nearest]).max() < 1e-3
    wrong = io.read(tmp_path / "theirs.spz", axes="rdf" if axes == "rub" else "rub")
    assert np.abs(wrong.means * (1, -1, -1) - splats.means).max() == 0
    edited = replace(splats, opacities=splats.opacities[::-1].copy())
    io.write(tmp_path / "b.spz", edited)
    oracle(tmp_path / "b.spz", tmp_path / "oracle.ply")
    difference = disagreement(io.read(tmp_path / "b.spz", axes=axes), float_columns(tmp_path / "oracle.ply"))
    assert difference["means"] == difference["rest"] == 0 and max(difference.values()) < 5e-4, difference


# ---- the command line and the session


def test_commands_say_and_take_axes(tmp_path: Path, capfd: Capture) -> None:
    write_spz(tmp_path / "a.spz", random_splats(100, 1), 4)
    silent(tmp_path / "a.spz")
    out = run(capfd, "info", tmp_path / "a.spz").out
    line = "right-down-front, as in PLY files; the file does not say (--in-axes rub, if it stands upside down)"
    assert f"axes       {line}" in out
    axes_record = run(capfd, "info", tmp_path / "a.spz", "--in-axes", "rub", "--json").json["frame"]
    assert (axes_record["axes"], axes_record["from"]) == ("rub", "choice")
    line = run(capfd, "convert", tmp_path / "a.spz", tmp_path / "b.spz", "--in-axes", "rub").out
    assert "axes: right-up-back, as chosen -> right-up-back, as chosen" in line
    assert (tmp_path / "b.spz").read_bytes() == (tmp_path / "a.spz").read_bytes()
    done = run(capfd, "convert", tmp_path / "a.spz", tmp_path / "c.ply", "--in-axes", "rdf", "--axes", "rub", "--json")
    assert done.json["input"]["frame"] == "rdf" and done.json["output"]["frame"] == "rub"
    assert np.array_equal(io.read(tmp_path / "c.ply", axes="rub").means, io.read(tmp_path / "a.spz", axes="rdf").means)
    done = run(capfd, "verify", tmp_path / "a.spz", tmp_path / "c.ply", "--in-axes", "rdf", "--axes", "rub", "--json")
    assert done.code == 0 and done.json["same"] == 100, done
    assert "--in-axes" in run(capfd, "info", tmp_path / "a.spz", "--in-axes", "up").error


def test_every_command_says_what_it_took_an_spz_file_for(tmp_path: Path, capfd: Capture) -> None:
    """An unmarked file, once opened by any command: a line that says so and how to turn it."""
    a, b, view = tmp_path / "a.spz", tmp_path / "b.spz", tmp_path / "v"
    write_spz(a, ball(300))
    write_spz(b, replace(ball(300), means=ball(300).means + np.float32(3)))
    line = "right-down-front, as in PLY files; the file does not say"
    for words in (
        ("info", a),
        ("convert", a, tmp_path / "c.ply"),
        ("render", a, "--out", view, "--size", 32, "--views", 1),
        ("turntable", a, "--out", tmp_path / "t.webp", "--size", 32, "--seconds", 0.2, "--fps", 10),
        ("grade", a, "--exposure", 0.5, "--out", tmp_path / "g.spz"),
        ("verify", a, tmp_path / "g.spz"),
        ("merge", a, b, "--out", tmp_path / "m.ply"),
        ("compare", a, b, "--out", tmp_path / "w", "--size", 32, "--views", 1),
    ):
        done = run(capfd, *words)
        assert done.code == 0 and line in done.out, done
        assert ("--in-axes rub" in done.out) == (words[0] not in ("merge", "compare")), done


def test_a_project_remembers_the_axes_and_what_is_up(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", random_splats(100, 1), 4)
    silent(tmp_path / "a.spz")
    before = (tmp_path / "a.spz").read_bytes()
    with Session(tmp_path / "a.spz", tmp_path / "a.splatproj", axes="rub") as session:
        means = session.splats.means.copy()
        assert session.scene.up == "-y"
        session.scene.set_up("+z")
        with pytest.raises(ValueError, match="up: expected one of"):
            session.scene.set_up("z")
        assert len(session.history) == 1
    with Session.load(tmp_path / "a.splatproj") as session:
        assert session.scene.up == "+z" and np.array_equal(session.splats.means, means)
        assert session.original.source is not None and session.original.source.axes == "rub"
        _, verification = session.files.export(tmp_path / "b.spz")
        assert verification.ok and verification.same == 100
    assert (tmp_path / "b.spz").read_bytes() == before


@pytest.mark.parametrize("embed", [True, False])
def test_projects_keep_the_axes_that_an_spz_file_was_taken_for(embed: bool, tmp_path: Path) -> None:
    """Files of this format differ and do not say: a project names what it took, whatever readers take them for."""
    import contextlib
    import sqlite3

    io.write(tmp_path / "a.spz", random_splats(100, 1))
    with Session(tmp_path / "a.spz", tmp_path / "a.splatproj", embed=embed) as session:
        means = session.splats.means.copy()
    with Session.load(tmp_path / "a.splatproj") as session:
        assert np.array_equal(session.splats.means, means)
    if embed:  # as an asset of another project or of a batch: its own bytes while any reader takes them alike
        file, axes = write_original(tmp_path / "a.splatproj", tmp_path / "new")
        assert (file.suffix, axes) == (".spz", "auto") and np.array_equal(io.read(file).means, means)
    with contextlib.closing(sqlite3.connect(tmp_path / "a.splatproj")) as db, db:
        assert db.execute("SELECT value FROM facts WHERE name = 'frame'").fetchall() == [("rdf",)]
        db.execute("UPDATE facts SET value = 'rub' WHERE name = 'frame'")
    with Session.load(tmp_path / "a.splatproj") as session:
        assert np.array_equal(session.splats.means, means * np.array([1, -1, -1], np.float32))
        if embed:
            file, axes = write_original(tmp_path / "a.splatproj", tmp_path / "turned")
            assert (file.suffix, axes) == (".ply", "auto") and np.array_equal(io.read(file).means, session.splats.means)
        _, verification = session.files.export(tmp_path / "b.spz")
        assert verification.ok
    assert (tmp_path / "b.spz").read_bytes() == (tmp_path / "a.spz").read_bytes()


def test_a_project_that_says_no_up_has_the_usual_one(tmp_path: Path) -> None:
    import contextlib
    import sqlite3

    with Session(alone(random_splats(20, 0)), tmp_path / "a.splatproj") as session:
        assert session.scene.up == "-y"
    with contextlib.closing(sqlite3.connect(tmp_path / "a.splatproj")) as db, db:
        assert not db.execute("SELECT value FROM facts WHERE name IN ('up', 'frame')").fetchall()
        db.execute("INSERT INTO facts VALUES ('up', 'sideways')")
    db.close()
    with Session.load(tmp_path / "a.splatproj") as session:
        assert session.scene.up == "-y"


def test_edit_in_chosen_axes(tmp_path: Path, capfd: Capture) -> None:
    """A painted SPZ file that was opened as right-up-back says so, and `verify` needs no word."""
    write_spz(tmp_path / "a.spz", ball(800), 4, "rub")
    silent(tmp_path / "a.spz")
    assert run(capfd, "render", tmp_path / "a.spz", "--in-axes", "rub", "--out", tmp_path / "v", "--size", 96).code == 0
    picture = paint(tmp_path / "v" / "view_000.png", tmp_path / "p.png", BOX)
    done = run(
        capfd, "edit", tmp_path / "a.spz", picture, "--in-axes", "rub", "--method", "lift", "--out", tmp_path / "b.spz"
    )
    assert done.code == 0 and "axes: right-up-back, as chosen" in done.out, done
    assert axis_of(tmp_path / "b.spz") == 4
    done = run(capfd, "verify", tmp_path / "a.spz", tmp_path / "b.spz")
    assert done.code == 0 and "axes: right-up-back, as the file says" in done.out, done
