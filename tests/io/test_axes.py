"""Which way a file's axes point: said, chosen, kept; and what splat-transform 2 and 3 make of SPZ files."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from splatpainter import io
from splatpainter.io.axes import AXES, flip
from splatpainter.io.spz import write_spz
from splatpainter.receipts import verify
from splatpainter.session import Session
from splatpainter.splats import Frame, Splats
from tests.support.cli_scenes import BOX, Capture, ball, paint, run
from tests.support.io_assets import disagreement, float_columns, random_splats
from tests.support.io_packed import alone, quats_apart, same_bits

if TYPE_CHECKING:
    from tests.support.node_oracle import SplatTransform

pytest_plugins = ["tests.support.node_oracle"]

FRAMES: tuple[Frame, ...] = ("rub", "rdf")
EVERY = ["a.ply", "a.compressed.ply", "a.splat", "a.spz", "a.sog", "a.glb"]
RECORD = 0xADBE0003


def axis_of(path: Path) -> int | None:
    """The frame that an SPZ file of version 4 names, without the package."""
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


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("frame", FRAMES)
def test_a_chosen_frame_is_kept_byte_for_byte(name: str, frame: Frame, tmp_path: Path) -> None:
    """Whatever was chosen: untouched assets are saved byte for byte, untouched rows of edited ones bit for bit."""
    io.write(tmp_path / name, random_splats(300, 1))
    splats = io.read(tmp_path / name, frame=frame)
    assert splats.source is not None and (splats.source.frame, splats.source.frame_from) == (frame, "choice")
    io.write(tmp_path / f"b{name}", splats)
    assert (tmp_path / f"b{name}").read_bytes() == (tmp_path / name).read_bytes()
    opacities = splats.opacities.copy()
    opacities[7] = 1 - opacities[7]
    edited = replace(splats, opacities=opacities)
    io.write(tmp_path / f"c{name}", edited)
    back = io.read(tmp_path / f"c{name}", frame=frame)
    rest = np.delete(np.arange(300), 7)
    assert same_bits(back, edited, rest) and np.abs(back.opacities - opacities).max() < 0.01
    verification = verify(tmp_path / name, tmp_path / f"c{name}", frame=frame)
    assert verification.ok and (verification.same, verification.changed) == (299, 1)
    assert verification.frame.startswith("right-up-back" if frame == "rub" else "right-down-front")


def test_frames_are_half_turns_of_each_other(tmp_path: Path) -> None:
    """rub is half a turn about x away from rdf, in every format; the reader's own frame is found again."""
    for name in EVERY:
        io.write(tmp_path / name, random_splats(60, 1))
        rub, rdf = (io.read(tmp_path / name, frame=frame) for frame in FRAMES)
        assert np.array_equal(rub.means, rdf.means * np.array([1, -1, -1], np.float32)), name
        natural = io.read(tmp_path / name)
        assert natural.source is not None and natural.source.frame == io.FORMATS[natural.source.format].frame
        signs = AXES[natural.source.frame]
        assert np.array_equal(natural.means, rdf.means * np.array(signs, np.float32)), name


def test_flips_restore_nan_bits() -> None:
    splats = random_splats(4, 2)
    splats.means.view(np.uint32)[0] = [0x7F800001, 0xFF800001, 0x80000000]  # signalling NaN, -NaN, -0
    for signs in ((1, -1, -1), (-1, -1, 1)):
        assert same_bits(flip(flip(splats, signs), signs), splats)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_new_spz_files_name_their_frame(
    version: int, tmp_path: Path, spz_reference: Callable[[list[Path]], list[Splats]]
) -> None:
    """By the extension, but for old versions in SPZ's own frame: there spz-js refuses bytes behind the rows. The
    reference implementation reads either frame as the same asset."""
    splats = random_splats(200, 3)
    for frame in ("auto", *FRAMES):
        write_spz(tmp_path / f"{frame}.spz", splats, version, frame)
    plain, rub, rdf = (io.read(tmp_path / f"{frame}.spz") for frame in ("auto", *FRAMES))
    assert [s.source and (s.source.frame, s.source.frame_from) for s in (plain, rub, rdf)] == [
        ("rub", "file" if version == 4 else "format"),
        ("rub", "file" if version == 4 else "format"),
        ("rdf", "file"),
    ]
    assert (tmp_path / "auto.spz").read_bytes() == (tmp_path / "rub.spz").read_bytes()
    if version == 4:
        assert (axis_of(tmp_path / "rub.spz"), axis_of(tmp_path / "rdf.spz")) == (4, 6)
    truths = spz_reference([tmp_path / f"{frame}.spz" for frame in FRAMES])
    for truth, ours in zip(truths, (rub, rdf), strict=True):
        assert np.array_equal(ours.means, truth.means) and np.array_equal(ours.sh[:, 1:], truth.sh[:, 1:])
    assert np.array_equal(rub.means, rdf.means)


def test_an_edit_says_a_chosen_frame(tmp_path: Path) -> None:
    """A file that says nothing stays so where it was taken for what it would be taken for, and says it otherwise."""
    path = tmp_path / "a.spz"
    write_spz(path, random_splats(100, 1), 4)
    silent(path)
    cases: list[tuple[Frame, int | None]] = [("auto", None), ("rub", None), ("rdf", 6)]
    for frame, code in cases:
        splats = io.read(path, frame=frame)
        io.write(tmp_path / "b.spz", replace(splats, opacities=splats.opacities[::-1].copy()), overwrite=True)
        back = io.read(tmp_path / "b.spz")
        assert axis_of(tmp_path / "b.spz") == code
        assert same_bits(replace(back, opacities=splats.opacities), splats)
        verification = verify(path, tmp_path / "b.spz")  # only one of them says it: it counts for both
        assert verification.same + verification.changed == 100 and verification.changed <= 100
        assert ("right-down-front" in verification.frame) == (frame == "rdf")
    wrong = io.read(tmp_path / "b.spz", frame="rub")
    assert wrong.source is not None and "the file says right-down-front" in wrong.source.problems[0]
    (tmp_path / "b.spz").unlink()
    io.write(tmp_path / "b.spz", wrong)  # untouched: the file's own bytes, whatever they say
    assert axis_of(tmp_path / "b.spz") == 6


def test_another_frame_changes_signs_alone(tmp_path: Path) -> None:
    """SPZ from one frame into the other and back: the same words of position, colour, scale and opacity."""
    write_spz(tmp_path / "a.spz", random_splats(200, 2), 4)
    splats = io.read(tmp_path / "a.spz")
    io.write(tmp_path / "b.spz", splats, frame="rdf")
    turned = io.read(tmp_path / "b.spz")
    assert axis_of(tmp_path / "b.spz") == 6
    for name in ("means", "scales", "opacities"):
        assert np.array_equal(getattr(turned, name), getattr(splats, name))
    assert np.abs(turned.sh - splats.sh).max() <= 1 / 128 and quats_apart(turned.quats, splats.quats) < 1e-6
    verification = verify(tmp_path / "a.spz", tmp_path / "b.spz")
    assert verification.same == 200 and "of the same axes" in verification.exact
    io.write(tmp_path / "c.spz", turned, frame="rub")
    again = io.read(tmp_path / "c.spz")
    assert np.array_equal(again.means, splats.means)


def test_bytes_behind_the_rows_are_no_place_for_a_frame(tmp_path: Path) -> None:
    """Spark puts a tree there, under a flag of its own; a file with one cannot say its frame."""
    import gzip

    write_spz(tmp_path / "a.spz", random_splats(50, 0), 3)
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    data[14] = 0x80
    data += bytes(range(12))
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data)))
    splats = io.read(tmp_path / "a.spz", frame="rdf")
    io.write(tmp_path / "b.spz", replace(splats, opacities=splats.opacities[::-1].copy()))
    assert gzip.decompress((tmp_path / "b.spz").read_bytes())[-12:] == bytes(range(12))


def test_wrong_words(tmp_path: Path) -> None:
    splats = random_splats(5, 0)
    io.write(tmp_path / "a.ply", splats)
    wrong: Any = "up"
    with pytest.raises(ValueError, match="frame: expected one of auto, rub, rdf, got 'up'"):
        io.read(tmp_path / "a.ply", frame=wrong)
    with pytest.raises(ValueError, match="frame: expected one of auto, rub, rdf, got 'up'"):
        io.write(tmp_path / "b.ply", splats, frame=wrong)
    assert not (tmp_path / "b.ply").exists()


# ---- splat-transform: version 2 turns SPZ to right-up-back, version 3 leaves it right-down-front


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_files_of_theirs_are_upright_here(degree: int, tmp_path: Path, splat_transform: SplatTransform) -> None:
    """They say nothing of their frame; said by the caller, both versions' files are the asset they were made from."""
    oracle, frame = splat_transform, splat_transform.spz_frame
    truth = random_splats(300, degree)
    io.write(tmp_path / "a.ply", truth)
    oracle(tmp_path / "a.ply", tmp_path / "theirs.spz")
    silently = io.read(tmp_path / "theirs.spz")
    assert (
        silently.source is not None
        and silently.source.frame_from == "format"
        and axis_of(tmp_path / "theirs.spz") is None
    )
    splats = io.read(tmp_path / "theirs.spz", frame=frame)
    nearest = np.argmin(((splats.means[:, None] - truth.means[None]) ** 2).sum(-1), 1)
    assert np.abs(splats.means - truth.means[nearest]).max() < 1e-3
    wrong = io.read(tmp_path / "theirs.spz", frame="rdf" if frame == "rub" else "rub")
    assert np.abs(wrong.means * (1, -1, -1) - splats.means).max() == 0
    edited = replace(splats, opacities=splats.opacities[::-1].copy())
    io.write(tmp_path / "b.spz", edited)
    oracle(tmp_path / "b.spz", tmp_path / "oracle.ply")
    difference = disagreement(io.read(tmp_path / "b.spz", frame=frame), float_columns(tmp_path / "oracle.ply"))
    assert difference["means"] == difference["rest"] == 0 and max(difference.values()) < 5e-4, difference


# ---- the command line and the session


def test_commands_say_and_take_frames(tmp_path: Path, capfd: Capture) -> None:
    write_spz(tmp_path / "a.spz", random_splats(100, 1), 4)
    silent(tmp_path / "a.spz")
    out = run(capfd, "info", tmp_path / "a.spz").out
    assert "frame      right-up-back, the default of this format; the file does not say" in out
    frame_name = run(capfd, "info", tmp_path / "a.spz", "--frame", "rdf", "--json").json["frame"]
    assert (frame_name["axes"], frame_name["from"]) == ("rdf", "choice")
    line = run(capfd, "convert", tmp_path / "a.spz", tmp_path / "b.spz", "--frame", "rdf").out
    assert "frame: right-down-front, as chosen -> right-down-front, as chosen" in line
    assert (tmp_path / "b.spz").read_bytes() == (tmp_path / "a.spz").read_bytes()
    done = run(
        capfd, "convert", tmp_path / "a.spz", tmp_path / "c.ply", "--frame", "rdf", "--out-frame", "rub", "--json"
    )
    assert done.json["input"]["frame"] == "rdf" and done.json["output"]["frame"] == "rub"
    assert np.array_equal(
        io.read(tmp_path / "c.ply", frame="rub").means, io.read(tmp_path / "a.spz", frame="rdf").means
    )
    done = run(
        capfd, "verify", tmp_path / "a.spz", tmp_path / "c.ply", "--frame", "rdf", "--out-frame", "rub", "--json"
    )
    assert done.code == 0 and done.json["same"] == 100, done
    assert "--frame" in run(capfd, "info", tmp_path / "a.spz", "--frame", "up").error


def test_a_project_remembers_the_frame_and_what_is_up(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", random_splats(100, 1), 4)
    silent(tmp_path / "a.spz")
    before = (tmp_path / "a.spz").read_bytes()
    with Session(tmp_path / "a.spz", tmp_path / "a.splatproj", frame="rdf") as session:
        means = session.splats.means.copy()
        assert session.up == "-y"
        session.set_up("+z")
        with pytest.raises(ValueError, match="up: expected one of"):
            session.set_up("z")
        assert len(session.history) == 1
    with Session.load(tmp_path / "a.splatproj") as session:
        assert session.up == "+z" and np.array_equal(session.splats.means, means)
        assert session.original.source is not None and session.original.source.frame == "rdf"
        _, verification = session.export(tmp_path / "b.spz")
        assert verification.ok and verification.same == 100
    assert (tmp_path / "b.spz").read_bytes() == before


def test_files_of_older_projects_have_the_usual_up(tmp_path: Path) -> None:
    import sqlite3

    with Session(alone(random_splats(20, 0)), tmp_path / "a.splatproj") as session:
        assert session.up == "-y"
    with sqlite3.connect(tmp_path / "a.splatproj") as db:
        assert not db.execute("SELECT value FROM facts WHERE name IN ('up', 'frame')").fetchall()
        db.execute("INSERT INTO facts VALUES ('up', 'sideways')")
    db.close()
    with Session.load(tmp_path / "a.splatproj") as session:
        assert session.up == "-y"


def test_edit_in_a_chosen_frame(tmp_path: Path, capfd: Capture) -> None:
    """A painted SPZ file that was opened as right-down-front says so, and `verify` needs no word."""
    write_spz(tmp_path / "a.spz", ball(800), 4, "rdf")
    silent(tmp_path / "a.spz")
    assert run(capfd, "render", tmp_path / "a.spz", "--frame", "rdf", "--out", tmp_path / "v", "--size", 96).code == 0
    picture = paint(tmp_path / "v" / "view_000.png", tmp_path / "p.png", BOX)
    done = run(
        capfd, "edit", tmp_path / "a.spz", picture, "--frame", "rdf", "--method", "lift", "--out", tmp_path / "b.spz"
    )
    assert done.code == 0 and "frame: right-down-front, as chosen" in done.out, done
    assert axis_of(tmp_path / "b.spz") == 6
    done = run(capfd, "verify", tmp_path / "a.spz", tmp_path / "b.spz")
    assert done.code == 0 and "frame: right-down-front, as the file says" in done.out, done
