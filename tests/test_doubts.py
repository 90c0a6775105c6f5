"""What looks wrong about an asset: each doubt on a file that deserves it, none on files that do not."""

from __future__ import annotations

import gzip
import io as bytes_io
import json
import pickle
import re
import struct
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter import io
from splatpainter.doubts import doubts, doubts_of_view
from splatpainter.splats import SH_C0, Splats
from tests.support import glb_files
from tests.support.cli_scenes import Capture, ball, run, saved
from tests.support.far_assets import UTM, far_ply
from tests.support.io_assets import random_splats

TYPES = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int": "i4", "uint": "u4"}


def ply(path: Path, columns: Mapping[str, np.ndarray], kinds: Mapping[str, str] | None = None) -> Path:
    """A little-endian PLY of these properties, written by hand; kinds: PLY types other than float."""
    types = {name: (kinds or {}).get(name, "float") for name in columns}
    rows = np.zeros(len(columns["x"]), [(name, "<" + TYPES[kind]) for name, kind in types.items()])
    for name, values in columns.items():
        rows[name] = values
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {kind} {name}" for name, kind in types.items()] + ["end_header", ""]
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
    return path


def columns_of(splats: Splats, colors: str = "f_dc") -> dict[str, np.ndarray]:
    """INRIA's columns: log-scales, logits, SH coefficients (or base colours 0..1 as red, green, blue)."""
    out = dict(zip("xyz", splats.means.T.astype(float), strict=True))
    base = splats.sh[:, 0].astype(float)
    if colors == "f_dc":
        out |= {f"f_dc_{k}": base[:, k] for k in range(3)}
    else:
        out |= {name: 0.5 + SH_C0 * base[:, k] for k, name in enumerate(("red", "green", "blue"))}
    alpha = splats.opacities.astype(float)
    out["opacity"] = np.log(alpha / (1 - alpha))
    out |= {f"scale_{k}": np.log(splats.scales[:, k].astype(float)) for k in range(3)}
    return out | {f"rot_{k}": splats.quats[:, k].astype(float) for k in range(4)}


def lines(path: Path) -> str:
    return "\n".join(doubt.line for doubt in doubts(io.read(path)))


@pytest.mark.parametrize(("kind", "most"), [("uchar", 255), ("float", 255), ("float", 100), ("int", 255)])
def test_opacities_of_another_scale_than_logits_are_named(kind: str, most: int, tmp_path: Path) -> None:
    columns = columns_of(ball(500))
    columns["opacity"] = np.linspace(0.05, 1, 500) * most
    words = lines(ply(tmp_path / "a.ply", columns, {"opacity": kind}))
    assert "opacity is 16 or more" in words and "logit" in words


def test_a_file_of_large_logits_is_sound(tmp_path: Path) -> None:
    """Training drives some opacities far up, and leaves others below a half."""
    columns = columns_of(ball(500))
    columns["opacity"] = np.where(np.arange(500) % 3, 20.0, -2.0)
    assert not lines(ply(tmp_path / "a.ply", columns))


def test_the_filter_of_mip_splatting_is_named(tmp_path: Path) -> None:
    columns = columns_of(ball(500)) | {"filter_3D": np.full(500, 0.02)}
    assert "filter_3D (Mip-Splatting)" in lines(ply(tmp_path / "a.ply", columns))


@pytest.mark.parametrize("radius", [1.0, 50.0, 0.01])
def test_sound_assets_raise_no_doubt(radius: float, tmp_path: Path) -> None:
    splats = ball(2000, radius=radius)
    for ending in ("ply", "compressed.ply", "splat", "spz", "sog", "glb"):
        assert lines(saved(tmp_path / f"a.{ending}", splats)) == "", ending
    assert lines(saved(tmp_path / "random.ply", random_splats(500, 3))) == ""
    large = replace(ball(2000, radius=50.0), scales=np.full((2000, 3), 2.0, np.float32))
    assert lines(saved(tmp_path / "large.ply", large)) == "", "log-scales above 0 of Gaussians that are so large"


def test_activated_values_are_named(tmp_path: Path) -> None:
    splats = ball(1000)
    columns = columns_of(splats)
    alone = {
        "sizes": {f"scale_{k}": splats.scales[:, k] for k in range(3)},
        "opacities": {"opacity": splats.opacities},
        "colours": {f"f_dc_{k}": 0.5 + SH_C0 * splats.sh[:, 0, k] for k in range(3)},
    }
    for wrong, values in alone.items():
        text = lines(ply(tmp_path / "a.ply", columns | values))
        assert "look activated" in text and f"so {wrong} are shown wrong" in text, text
        assert "export again" in text and "\n" not in text
    together = lines(ply(tmp_path / "a.ply", columns | alone["sizes"] | alone["opacities"]))
    assert "(stored without log, logit), so sizes and opacities are shown wrong" in together


def test_activated_values_are_said_by_the_commands(tmp_path: Path, capfd: Capture) -> None:
    splats = ball(1000)
    asset = ply(tmp_path / "a.ply", columns_of(splats) | {f"scale_{k}": splats.scales[:, k] for k in range(3)})
    done = run(capfd, "info", asset)
    assert "doubt      scale_0..2 are all above 0" in done.out
    done = run(capfd, "render", asset, "--out", tmp_path / "v", "--views", 1, "--size", 32, "--json")
    assert "look activated" in done.json["doubts"][0] and done.err.count("look activated") == 1
    done = run(capfd, "convert", asset, tmp_path / "b.glb")
    assert "splatpainter: warning: " in done.err and "look activated" in done.err


def glb_of(splats: Splats, generator: str, log_scales: bool) -> bytes:
    attributes = glb_files.attributes_of(splats)
    if log_scales:
        attributes["SCALE"] = np.log(splats.scales)
    doc, binary = glb_files.parts(glb_files.build(attributes))
    doc["asset"]["generator"] = generator
    return glb_files.pack(doc, binary)


def stored_scales(path: Path) -> np.ndarray:
    doc, binary = glb_files.parts(path.read_bytes())
    return glb_files.columns(glb_files.pack({**doc, "meshes": doc["meshes"][1:]}, binary))["SCALE"]


@pytest.mark.parametrize(
    ("generator", "log_scales"),
    [
        ("splat-transform 1.10.1", True),
        ("splat-transform 2.3.1", True),
        ("splat-transform 2.6.9", True),
        ("splat-transform 2.7.0", False),
        ("splat-transform 3.7.0", False),
        ("splat-transform 10.0.0", False),
        ("other 1.0.0", False),
    ],
)
def test_log_scales_of_old_glb_files_are_read_as_such(generator: str, log_scales: bool, tmp_path: Path) -> None:
    """Scales above 1 too, of which the logarithms look sound."""
    splats = random_splats(60, 1, log_scale=0.8)
    (tmp_path / "a.glb").write_bytes(glb_of(splats, generator, log_scales))
    read = io.read(tmp_path / "a.glb")
    np.testing.assert_allclose(read.scales, splats.scales, rtol=1e-5)
    assert (generator in lines(tmp_path / "a.glb")) == log_scales
    io.write(tmp_path / "same.glb", read)
    assert (tmp_path / "same.glb").read_bytes() == (tmp_path / "a.glb").read_bytes()


def test_an_edit_of_log_scales_stores_logarithms(tmp_path: Path) -> None:
    splats = random_splats(60, 1, log_scale=0.8)
    (tmp_path / "a.glb").write_bytes(glb_of(splats, "splat-transform 2.3.1", True))
    read = io.read(tmp_path / "a.glb")
    scales = read.scales.copy()
    scales[5] *= np.float32(1.5)
    edited = replace(read, scales=scales)
    io.write(tmp_path / "b.glb", edited)
    before, after = (stored_scales(tmp_path / name) for name in ("a.glb", "b.glb"))
    assert np.flatnonzero((before != after).any(1)).tolist() == [5]
    np.testing.assert_allclose(after[5], np.log(splats.scales[5] * 1.5), atol=1e-5)
    more = edited.append(edited.take(np.array([1])))
    io.write(tmp_path / "c.glb", more)
    again = io.read(tmp_path / "c.glb").scales
    assert np.array_equal(np.delete(again, 5, 0), np.delete(more.scales, 5, 0)), "with a row appended too"


def test_negative_scales_of_other_programs_name_the_suspicion(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(glb_of(random_splats(60, 1), "other 1.0", True))
    splats = io.read(tmp_path / "a.glb")
    with_one = replace(splats, scales=np.vstack([np.abs(splats.scales[:1]), splats.scales[1:]]))
    (doubt,) = doubts(with_one)
    assert "probably logarithms" in doubt.line
    assert ["probably logarithms" in one.line for one in doubts(splats)] == [True, False], "also where all are"


def test_lossy_planes_of_a_sog(tmp_path: Path) -> None:
    io.write(tmp_path / "d" / "meta.json", ball(600))
    assert lines(tmp_path / "d") == ""
    meta = json.loads((tmp_path / "d" / "meta.json").read_text())
    for name in meta["means"]["files"]:
        with Image.open(tmp_path / "d" / name) as image:
            out = bytes_io.BytesIO()
            image.convert("RGBA").save(out, "WEBP", quality=80)
        (tmp_path / "d" / name).write_bytes(out.getvalue())
    text = lines(tmp_path / "d")
    assert text.startswith(", ".join(meta["means"]["files"]) + ": lossy WebP"), text


@pytest.mark.parametrize(
    ("plane", "doubt"),
    [
        ("quats.webp", "the image of the rotations has no transparency"),
        ("sh0.webp", "the image of the colours has no transparency: every Gaussian is opaque"),
    ],
)
def test_images_of_a_sog_that_lost_their_alpha(plane: str, doubt: str, tmp_path: Path) -> None:
    io.write(tmp_path / "d" / "meta.json", ball(600))
    assert doubt not in lines(tmp_path / "d")
    with Image.open(tmp_path / "d" / plane) as image:
        opaque = image.convert("RGB")
    opaque.save(tmp_path / "d" / plane, "WEBP", lossless=True)
    assert doubt in lines(tmp_path / "d")


def test_rotations_alike_have_one_alpha_for_a_reason(tmp_path: Path) -> None:
    # All turned alike about z.
    turned = replace(ball(600), quats=np.repeat(np.array([[0.1, 0, 0, 1]], np.float32), 600, 0))
    io.write(tmp_path / "e" / "meta.json", turned)
    assert "transparency" not in lines(tmp_path / "e")


@pytest.mark.parametrize("share", [0.5, 0.95])
@pytest.mark.parametrize("ending", ["ply", "splat", "compressed.ply", "glb"])
def test_rows_that_were_never_written(ending: str, share: float, tmp_path: Path, capfd: Capture) -> None:
    """A download whose disk space was set aside, and which ended half-way. In GLB attributes lie behind each other, in
    compressed PLY SH behind all rows: so what is missing differs."""
    asset = saved(tmp_path / f"a.{ending}", random_splats(600, 1))
    assert "zeros" not in lines(asset)
    data = asset.read_bytes()
    written = int(share * len(data))
    asset.write_bytes(data[:written] + bytes(len(data) - written))
    done = run(capfd, "render", asset, "--out", tmp_path / "v", "--views", 1, "--size", 32)
    assert done.code == 0 and " of 600 rows hold zeros alone: they were probably never written" in done.err


def test_zeros_that_are_written_are_no_missing_rows(tmp_path: Path) -> None:
    """SH bands that the last rows lack, as of sheets and merged assets; rows that were emptied; one grey colour."""
    splats = random_splats(600, 2)
    sh, opacities = splats.sh.copy(), splats.opacities.copy()
    sh[300:, 1:], opacities[500:] = 0, 0
    for name, changed in {
        "bands": replace(splats, sh=sh),
        "empty": replace(splats, sh=sh, opacities=opacities),
        "grey": replace(splats, sh=np.zeros_like(sh)),
        "plain": replace(splats, sh=np.zeros_like(sh[:, :1]), means=splats.means * np.array([1, 0, 1], np.float32)),
    }.items():
        for ending in ("ply", "splat", "compressed.ply", "glb", "spz"):
            asset = saved(tmp_path / f"{name}.{ending}", changed)
            assert "zeros" not in lines(asset), asset.name


@pytest.mark.parametrize("kind", ["int", "uint", "ushort", "float", "uchar"])
def test_colours_of_0_to_255_are_read_whatever_their_type(kind: str, tmp_path: Path) -> None:
    splats = ball(500, degree=0)
    columns = columns_of(splats, "rgb")
    bytes_of = {name: np.rint(255 * columns[name]) for name in ("red", "green", "blue")}
    path = ply(tmp_path / "a.ply", columns | bytes_of, dict.fromkeys(bytes_of, kind))
    read = io.read(path)
    truth = np.stack(list(bytes_of.values()), 1) / 255
    np.testing.assert_allclose(0.5 + SH_C0 * read.sh[:, 0], truth, atol=1e-5)
    assert ("read as 0..255" in lines(path)) == (kind != "uchar")
    sh = read.sh.copy()
    sh[3] = 0
    io.write(tmp_path / "b.ply", replace(read, sh=sh))
    again = io.read(tmp_path / "b.ply")
    np.testing.assert_allclose(0.5 + SH_C0 * again.sh[3, 0], 0.5, atol=0.003)
    assert np.array_equal(np.delete(again.sh, 3, 0), np.delete(read.sh, 3, 0))


def test_colours_of_other_scales_stay_what_their_type_says(tmp_path: Path) -> None:
    splats = ball(500, degree=0)
    columns = columns_of(splats, "rgb")
    names = ("red", "green", "blue")
    for kind, most in (("ushort", 65535), ("float", 1)):
        path = ply(tmp_path / "a.ply", columns | {n: columns[n] * most for n in names}, dict.fromkeys(names, kind))
        np.testing.assert_allclose(io.read(path).sh, splats.sh, atol=1e-4)
        assert lines(path) == ""


@pytest.mark.parametrize(("value", "words"), [(400.0, "255"), (-1.0 / SH_C0, "black")])
def test_colours_that_are_white_or_black_all_over(value: float, words: str, tmp_path: Path) -> None:
    columns = columns_of(ball(200))
    columns |= {f"f_dc_{k}": np.full(200, value) for k in range(3)}
    assert words in lines(ply(tmp_path / "a.ply", columns))


def test_rounded_positions(tmp_path: Path) -> None:
    columns = columns_of(ball(1000))
    for k, name in enumerate("xyz"):
        columns[name] = columns[name] + UTM[k]
    text = lines(ply(tmp_path / "a.ply", columns))
    assert "float32 has steps of" in text and "of 1,000 are distinct" in text and "double x, y, z" in text
    for order in ("<", "="):
        far_ply(tmp_path / "far.ply", ball(300), order=order)
        assert lines(tmp_path / "far.ply") == ""
    io.write(tmp_path / "far.glb", io.read(tmp_path / "far.ply"))
    assert lines(tmp_path / "far.glb") == ""
    io.write(tmp_path / "far.spz", io.read(tmp_path / "far.ply"))
    assert "rounded when the file was written" in lines(tmp_path / "far.spz")


def test_nothing_to_see(tmp_path: Path, capfd: Capture) -> None:
    splats = ball(300)
    clear = replace(splats, opacities=np.full(300, 0.001, np.float32))
    assert "all of 300 Gaussians are transparent" in doubts(clear)[0].line
    broken = replace(splats, means=np.full((300, 3), np.nan, np.float32))
    assert "none of 300 Gaussians can be drawn" in doubts(broken)[0].line
    assert "no Gaussian" in doubts(splats.take(np.zeros(0, int)))[0].line
    done = run(capfd, "info", saved(tmp_path / "a.ply", broken))
    assert done.code == 0 and "training or an export went wrong" in done.out


def test_a_camera_that_sees_nothing(tmp_path: Path, capfd: Capture) -> None:
    splats = ball(300)
    towards = sp.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), width=32, height=32)
    assert doubts_of_view(splats, towards) == ()
    away = sp.look_at((0, 0, -4), (0, 0, -8), (0, -1, 0), width=32, height=32)
    assert "all are behind the camera" in doubts_of_view(splats, away)[0].line
    beside = sp.look_at((0, 0, -4), (9, 0, -4), (0, -1, 0), width=32, height=32)
    assert "beside the picture" in doubts_of_view(splats, beside)[0].line
    near = replace(splats, scales=splats.scales * 100)
    assert doubts_of_view(near, beside) == (), "so large that they reach into the picture"
    (tmp_path / "cam.json").write_text(away.to_json())
    asset = saved(tmp_path / "a.ply", splats)
    done = run(capfd, "render", asset, "--camera", tmp_path / "cam.json", "--out", tmp_path / "v")
    assert done.code == 0 and "view_000: none of 300 Gaussians is in view" in done.err
    done = run(capfd, "edit", asset, tmp_path / "v" / "view_000.png", "--out", tmp_path / "out.ply")
    assert "none of 300 Gaussians is in view" in done.error and not (tmp_path / "out.ply").exists()


PAGE = b"\n<!DOCTYPE html><html><head><title>Not found</title></head></html>" + bytes(100)
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 123456789\n"
FILM = struct.pack(">I", 24) + b"ftypisom" + bytes(64)
KINDS = [
    (PAGE, "a web page"),
    (b"\xef\xbb\xbf<html>" + bytes(90), "a web page"),
    (b'{"message": "Not Found", "status": "404"}' + b" " * 64, "a text "),
    (b"Access denied. Sign in to download this file, please." + b"\n" * 64, "a text "),
    (b"\x28\xb5\x2f\xfd" + bytes(60), "packed by zstd"),
    (b'{"asset":{"version":"2.0"}}' + b" " * 64, "a text "),
    (b"\xfd7zXZ\0" + bytes(58), "packed by xz"),
    (b"BZh9" + bytes(60), "packed by bzip2"),
    (struct.pack(">I", 24) + b"ftypheic" + bytes(52), "a picture"),
    (b"\x76\x2f\x31\x01" + bytes(60), "a picture"),
    (b"BLENDER-v300" + bytes(52), "a scene of Blender"),
    (b"Kaydara FBX Binary  \0" + bytes(43), "a scene"),
    (b"\x93NUMPY\1\0" + bytes(56), "an array of numpy"),
    (b"LASF" + bytes(60), "a point cloud"),
    (POINTER, "a git-LFS pointer"),
    (FILM, "a film"),
    (b"\x1a\x45\xdf\xa3" + bytes(60), "a film"),
    (b"\x89PNG\r\n\x1a\n" + bytes(56), "a picture"),
    (b"\xff\xd8\xff\xe0" + bytes(60), "a picture"),
    (b"RIFF\x10\0\0\0AVI " + bytes(52), "a film"),
    (b"RIFF\x10\0\0\0WEBP" + bytes(52), "a picture"),
    (bytes(257) + b"ustar" + bytes(26), "a tar archive"),
    (b"\0\0\0\x08wide\0\0\x10\0mdat" + bytes(48), "a film"),
    ((b"\x47\x40\0\x10" + bytes(184)) * 8, "a film"),
    (b"FLV\x01\x05" + bytes(59), "a film"),
    (b"OggS\0\2" + bytes(58), "a film"),
    (b"\0\0\x01\xba\x44" + bytes(59), "a film"),
    (b"II*\0\x08\0\0\0" + bytes(56), "a picture"),
    (b"8BPS\0\1" + bytes(58), "a picture"),
    (b"BM\x36\x10\0\0\0\0\0\0\x36\0\0\0\x28\0\0\0" + bytes(46), "a picture"),
    (b"\0\0\0\x0cJXL \r\n\x87\n" + bytes(52), "a picture"),
    (b"\0\x05\x16\x07\0\2\0\0Mac OS X        " + bytes(40), "a shadow file of macOS"),
    (b"\x7fELF" + bytes(60), "a program"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(56), "a document"),
    (pickle.dumps([*range(500)], protocol=4), "a pickle of Python"),
    (pickle.dumps({"means": [0.5] * 90}, protocol=2), "a pickle of Python"),
    (
        struct.pack("<Q", 64) + b'{"a":{"dtype":"F32","shape":[6],"data_offsets":[0,24]}}'.ljust(64) + bytes(56),
        "weights",
    ),
    (b"ball".ljust(80) + struct.pack("<I", 6) + (struct.pack("<12f", 0, 0, 1, *range(9)) + b"\0\0") * 6, "a mesh"),
]


@pytest.mark.parametrize(
    ("member", "what"),
    [
        ("archive/data.pkl", "a checkpoint of a trainer"),
        ("means.npy", "arrays of numpy"),
        ("scene.usdc", "a USD scene"),
        ("gs/point_cloud.ply", "unpack it, then open gs/point_cloud.ply"),
    ],
)
@pytest.mark.parametrize("ending", ["pt", "ply", "sog", "usdz"])
def test_zips_that_are_no_sog(member: str, what: str, ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{ending}"
    with zipfile.ZipFile(path, "w") as bundle:
        bundle.writestr(member, b"x")
    with pytest.raises(ValueError, match=re.escape(what)):
        sp.read(path)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("a.psht", "a project of Postshot"),
        ("a.lcc", "a scene of XGRIDS"),
        ("a.splatv", "a moving scene"),
        ("a.safetensors", "weights"),
        ("a.usda", "a USD scene"),
    ],
)
def test_files_of_other_programs_are_named_by_their_ending(name: str, what: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\x01\x02\xff" * 40)
    with pytest.raises(ValueError, match=what):
        sp.read(tmp_path / name)


@pytest.mark.parametrize("ending", ["splat", "ply", "spz", "sog"])
@pytest.mark.parametrize("text", [b"404: Not Found", b"Not Found"])
def test_a_server_s_short_answer_is_a_text(text: bytes, ending: str, tmp_path: Path) -> None:
    (tmp_path / f"a.{ending}").write_bytes(text)
    with pytest.raises(ValueError, match="is a text '.*not found'"):
        sp.read(tmp_path / f"a.{ending}")


@pytest.mark.parametrize("ending", ["splat", "ply", "spz", "ksplat", "sog", "glb", "bin"])
@pytest.mark.parametrize(("data", "what"), KINDS)
def test_files_that_are_no_splats(data: bytes, what: str, ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"chair.{ending}"
    path.write_bytes(data[: 32 * (len(data) // 32)] if ending == "splat" and what != "a git-LFS pointer" else data)
    with pytest.raises(ValueError, match=rf"chair\.{ending}: is {what}.*, not a splat file; ") as error:
        io.read(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("ending", ["ply.gz", "spz"])
def test_a_ply_packed_by_gzip_is_no_spz(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"chair.{ending}"
    path.write_bytes(gzip.compress(saved(tmp_path / "a.ply", ball(20)).read_bytes()))
    with pytest.raises(ValueError, match="is a PLY file packed by gzip, not an SPZ file; unpack it first"):
        io.read(path)


def test_binary_numbers_sent_as_text_are_named(tmp_path: Path) -> None:
    """As FTP and git make it of a file, and not of sound ones with line ends of Windows."""
    original = ply(tmp_path / "a.ply", columns_of(ball(500))).read_bytes()
    (tmp_path / "sent.ply").write_bytes(original.replace(b"\n", b"\r\n"))
    assert "the file was sent or stored as text" in lines(tmp_path / "sent.ply")
    end = original.index(b"end_header\n") + len("end_header\n")
    for rest in (b"", b"\r\n", b"more\n"):
        (tmp_path / "windows.ply").write_bytes(original[:end].replace(b"\n", b"\r\n") + original[end:] + rest)
        assert lines(tmp_path / "windows.ply") == ""
    # Numbers without a line feed, and one more line behind: two bytes too many for one carriage return.
    numbers = original[end:].replace(b"\n", b"\v")
    (tmp_path / "windows.ply").write_bytes(original[:end].replace(b"\n", b"\r\n") + numbers + b"\r\n")
    assert "sent or stored as text" not in lines(tmp_path / "windows.ply")


def test_a_ply_packed_by_gzip_says_so(tmp_path: Path) -> None:
    path = tmp_path / "chair.ply"
    path.write_bytes(b"\x1f\x8b\x08" + bytes(61))
    with pytest.raises(ValueError, match="is packed by gzip; unpack it first"):
        io.read(path)
    # As whole rows of 32 bytes they would be Gaussians of chance.
    packed = gzip.compress(saved(tmp_path / "a.splat", ball(50, degree=0)).read_bytes())
    for ending in ("splat", "ksplat"):
        (tmp_path / f"b.{ending}").write_bytes(packed + bytes(-len(packed) % 32))
        with pytest.raises(ValueError, match="is packed by gzip; unpack it first"):
            io.read(tmp_path / f"b.{ending}")


def test_a_splat_file_of_any_positions_is_read(tmp_path: Path) -> None:
    splats = ball(50, degree=0)
    for first in (0.0, 1.0, -1e-20, 3e38):
        means = splats.means.copy()
        means[0] = first
        path = saved(tmp_path / "a.splat", replace(splats, means=means))
        assert len(io.read(path)) == 50


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("trbf_center", "trbf_scale", "motion_0"), "Spacetime Gaussians"),
        (("t", "scale_t"), "all moments are shown at once"),
        (("beta", "sb_params_0"), "Beta Splatting"),
        (("shape",), "fall-off"),
        (("t",), ""),
        (("beta", "obj_dc_0"), ""),
    ],
)
def test_gaussians_of_other_kinds_are_named(names: tuple[str, ...], words: str, tmp_path: Path) -> None:
    columns = columns_of(ball(500)) | {name: np.full(500, 0.5) for name in names}
    doubted = lines(ply(tmp_path / "a.ply", columns))
    assert words in doubted and bool(doubted) == bool(words)
