"""Shards: what goes in comes out, in any order of arrival, killed at any moment; damage is seen and counted."""

from __future__ import annotations

import gc
import io
import json
import os
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splattrain.data.records import decode_radiance, decode_sample, encode_sample
from splattrain.data.samples import PosedViews, Sample
from splattrain.data.shards import INDEX, WAITING, RenderedScene, ShardStream, ShardWriter, check, read_index
from tests.support.data_meshes import random_sample

SPEC = {"seed": 3, "recipe": {"size": 12, "share": (0.1, 0.2)}}


def scene(number: int, count: int = 2) -> RenderedScene:
    """Objects alternate between two names."""
    name = f"object{number % 2}"
    kinds = [("stroke", "text")[step % 2] for step in range(count)]
    samples = [encode_sample(random_sample(10 * number + step, name, kinds[step])) for step in range(count)]
    return RenderedScene(name, samples, kinds)


def written(folder: Path, scenes: int = 5, per_shard: int = 2, order: list[int] | None = None) -> Path:
    with ShardWriter(folder, SPEC, scenes, per_shard) as writer:
        for number in order or range(scenes):
            writer.add(number, scene(number))
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file() and path.name != ".lock"
    }


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


# Samples as files


def same(one: Sample, other: Sample) -> None:
    assert (one.name, one.kind, one.mode) == (other.name, other.kind, other.mode)
    for name in ("base", "edited", "novel_before", "novel_after"):
        a, b = getattr(one, name), getattr(other, name)
        assert a.cameras == b.cameras and a.colors.shape == b.colors.shape and a.colors.dtype == b.colors.dtype
        assert all((p.world_to_camera == q.world_to_camera).all() for p, q in zip(a.cameras, b.cameras, strict=True))
        assert len(a) == 0 or float((a.colors - b.colors).abs().max()) <= 0.5 / 255 + 1e-6
    assert (one.masks == other.masks).all() and (one.near == other.near).all()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.allclose(getattr(one.asset, name), getattr(other.asset, name), rtol=1e-5, atol=1e-6), name
    assert other.asset.color_space == one.asset.color_space and other.asset.antialiased == one.asset.antialiased


def test_a_sample_comes_back() -> None:
    sample = random_sample(1)
    same(sample, decode_sample(encode_sample(sample), "here"))


def test_a_sample_without_edited_views_and_in_another_colour_space_comes_back() -> None:
    sample = random_sample(2, kind="plain", edited=0)
    sample = replace(sample, asset=replace(sample.asset, color_space="linear", antialiased=True))
    same(sample, decode_sample(encode_sample(sample), "here"))


def test_linear_pictures_come_back_as_halves() -> None:
    pytest.importorskip("mitsuba")
    light = np.random.default_rng(0).uniform(0, 30, (3, 12, 12, 3)).astype(np.float32)
    files = encode_sample(random_sample(1), {"after": light}, exposure={"after": 0.5})
    assert np.allclose(decode_radiance(files, "after", "here"), light, rtol=2**-11)
    assert len(decode_radiance(files, "before", "here")) == 0
    assert json.loads(files["json"])["exposure"] == {"after": 0.5}


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("after_01.png", None, "the sample has no 'after_01.png'"),
        ("json", None, "the sample has no 'json'"),
        ("json", b"{", "cannot be read as a sample"),
        ("json", b'{"version": 9}', "expected a sample of version 1, got 9"),
        ("mask_00.png", b"\x89PNG\r\n", "cannot be read as a sample"),
        ("asset.ply", b"ply\n", "cannot be read as a sample"),
    ],
)
def test_a_broken_sample_says_what_is_broken(name: str, data: bytes | None, words: str) -> None:
    files = encode_sample(random_sample(1))
    files = {key: value for key, value in files.items() if key != name} | ({} if data is None else {name: data})
    with pytest.raises(ValueError, match=f"^here: .*{words}"):
        decode_sample(files, "here")


# Writing


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # webdataset leaves files open
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_plain_webdataset_reads_the_shards(tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset")
    folder = written(tmp_path / "shards")
    urls = [str(path) for path in sorted(folder.glob("*.tar"))]
    records = list(webdataset.WebDataset(urls, shardshuffle=False, empty_check=False))
    assert [item["__key__"] for item in records] == [f"{n:06d}_{step:02d}" for n in range(5) for step in range(2)]
    for k, item in enumerate(records):
        sample = random_sample(10 * (k // 2) + k % 2, f"object{k // 2 % 2}", ("stroke", "text")[k % 2])
        assert json.loads(item["json"])["kind"] == sample.kind
        picture = np.asarray(Image.open(io.BytesIO(item["after_02.png"]))) / 255
        assert np.abs(picture - sample.novel_after.colors[2].numpy()).max() <= 0.5 / 255 + 1e-6
        same(sample, decode_sample({key: item[key] for key in item if not key.startswith("__")}, "here"))
    gc.collect()  # here, where the warnings about its files are ignored


def test_the_bytes_do_not_depend_on_who_finished_first(tmp_path: Path) -> None:
    one, other = written(tmp_path / "a"), written(tmp_path / "b", order=[4, 3, 1, 0, 2])
    assert contents(one) == contents(other)
    assert sorted(contents(one)) == ["index.json", "shard-00000.tar", "shard-00001.tar", "shard-00002.tar"]
    assert not (one / WAITING).exists()


def plain_scene(number: int) -> RenderedScene:
    """As the writer that is killed makes it."""
    return RenderedScene("thing", [{"txt": b"%d" % number * 5000}], ["plain"])


KILLED = """
import os, sys
from pathlib import Path
from splattrain.data.shards import RenderedScene, ShardWriter

def write(folder, after):
    rename, left = os.replace, after
    def replace(*names):
        nonlocal left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), 9)
        rename(*names)
    os.replace = replace
    with ShardWriter(Path(folder), {"seed": 3}, 5, 2) as writer:
        for number in range(5):
            writer.add(number, RenderedScene("thing", [{"txt": b"%d" % number * 5000}], ["plain"]))

folder, *counts = sys.argv[1:]
for after in counts:
    if len(counts) == 1:
        write(f"{folder}/{after}", int(after))
    child = os.fork()
    if child == 0:
        try:
            write(f"{folder}/{after}", int(after))
        finally:
            os._exit(1)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
"""A program: arguments are a folder and numbers of renames; for each number a writer of folder/NUMBER that is killed
before one more. Several are forked from one process, which imports once, and their exit codes are printed."""
KILLED_AFTER = {0: 0, 2: 1, 3: 2, 4: 2, 5: 2, 7: 4}
"""Renames before the kill -> scenes that are there then."""


@pytest.fixture(scope="module")
def killed_writers(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, int]]:
    """The folder of the writers' folders, and how each writer ended."""
    folder = tmp_path_factory.mktemp("killed")
    command = [sys.executable, "-c", KILLED, str(folder)]
    if not hasattr(os, "fork"):
        return folder, {n: subprocess.run([*command, str(n)], check=False).returncode for n in KILLED_AFTER}
    done = subprocess.run([*command, *map(str, KILLED_AFTER)], capture_output=True, text=True, check=True)
    return folder, dict(zip(KILLED_AFTER, map(int, done.stdout.split()), strict=True))


@pytest.mark.parametrize(("after", "finished"), KILLED_AFTER.items())
def test_a_killed_run_carries_on_and_ends_with_the_same_bytes(
    tmp_path: Path, killed_writers: tuple[Path, dict[int, int]], after: int, finished: int
) -> None:
    """Killed (SIGKILL) before one of its renames, the only moments that count. They are: the index; then scene, scene,
    shard, index, again and again."""
    killed, uninterrupted = killed_writers[0] / str(after), tmp_path / "uninterrupted"
    assert killed_writers[1][after] == (9 if sys.platform == "win32" else -9)
    for folder, expected in ((killed, range(finished, 5)), (uninterrupted, range(5))):
        with ShardWriter(folder, {"seed": 3}, 5, 2) as writer:
            left = writer.missing()
            for number in left:
                writer.add(number, plain_scene(number))
        assert left == list(expected)
    assert contents(killed) == contents(uninterrupted)
    assert not list(killed.rglob(".*.part")) and check(killed).complete


def test_a_finished_set_can_be_made_longer(tmp_path: Path) -> None:
    folder = written(tmp_path / "shards", scenes=3)
    before = contents(folder)
    with ShardWriter(folder, SPEC, 6, 2) as writer:
        assert writer.missing() == [3, 4, 5]
        for number in writer.missing():
            writer.add(number, scene(number))
    after = contents(folder)
    assert all(after[name] == before[name] for name in before if name != INDEX)
    assert len(ShardStream(folder)) == 12 and check(folder).complete


def test_another_run_is_refused_and_so_is_a_second_writer(tmp_path: Path) -> None:
    folder = written(tmp_path / "shards")
    with pytest.raises(ValueError, match=r"holds shards of another run \(seed was 3, now 4\)"):
        ShardWriter(folder, {**SPEC, "seed": 4}, 5, 2)
    with ShardWriter(folder, SPEC, 5, 2), pytest.raises(ValueError, match="another run is writing shards here"):
        ShardWriter(folder, SPEC, 5, 2)
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="cannot be made"):
        ShardWriter(tmp_path / "file", SPEC, 5, 2)


def test_skipped_scenes_and_samples_are_in_the_index(tmp_path: Path) -> None:
    with ShardWriter(tmp_path, SPEC, 3, 1) as writer:
        writer.add(0, RenderedScene("bad", skipped=["bad.glb: no area"]))
        writer.add(1, replace(scene(1, 1), skipped=["nothing can be seen"]))
        writer.add(2, scene(2))
    index = read_index(tmp_path)
    assert [entry["reason"] for entry in index["skipped"]] == ["bad.glb: no area", "nothing can be seen"]
    assert [entry["file"] for entry in index["shards"]] == ["shard-00000.tar", "shard-00001.tar"]
    assert len(ShardStream(tmp_path)) == 3 and check(tmp_path).complete and check(tmp_path).skipped == 2


def test_a_full_disk_is_one_clear_error_and_leaves_no_half_shard(tmp_path: Path) -> None:
    """The kernel refuses to let a file grow past a limit, as it does on a full disk."""
    resource = pytest.importorskip("resource")

    folder = tmp_path / "shards"
    with ShardWriter(folder, SPEC, 2, 2) as writer:
        writer.add(0, scene(0))
        size = (folder / WAITING / "000000.tar").stat().st_size
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        for limit in (size // 2, size + 4096):  # the scene does not fit; the scene does, the shard does not
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
            try:
                with pytest.raises(ValueError, match=r"\.tar: cannot be written \(File too large\)$"):
                    writer.add(1, scene(1))
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
            assert not list(folder.glob("*.tar")) and not list(folder.rglob(".*.part"))
            assert read_index(folder)["shards"] == []
    with ShardWriter(folder, SPEC, 2, 2) as writer:  # room again
        assert writer.missing() == []
    assert len(ShardStream(folder)) == 4


# Damage


@pytest.mark.parametrize("harm", ["cut", "flip", "missing"])
def test_damage_is_reported_counted_and_survived(tmp_path: Path, harm: str) -> None:
    folder = written(tmp_path / "shards")
    path = folder / "shard-00001.tar"
    if harm == "cut":
        path.write_bytes(path.read_bytes()[:-700])
    elif harm == "flip":
        flip(path, 3000)
    else:
        path.unlink()
    words = {"cut": "cut short", "flip": "another checksum", "missing": "is missing"}[harm]
    health = check(folder)
    assert [words in problem for problem in health.problems] == [True]
    assert not health.complete and health.samples == 6
    stream = ShardStream(folder, seed=1)
    names = [stream.files(i)[1] for i in range(len(stream))]
    assert not {name for name in names if name[:6] in ("000002", "000003")} and len(set(names)) == 6
    assert list(stream.skipped) == ["shard-00001.tar"] and words in stream.skipped["shard-00001.tar"]
    assert stream.replaced == 4
    with pytest.raises(ValueError, match=words):
        [ShardStream(folder, seed=1, strict=True).files(i) for i in range(10)]


def test_a_stray_tar_and_a_broken_index_are_problems(tmp_path: Path) -> None:
    folder = written(tmp_path / "shards")
    (folder / "copy.tar").write_bytes(b"")
    assert "copy.tar: is not in the index" in check(folder).problems[0]
    for text, words in (
        ("{", "is not an index of shards"),
        ("{}", "is not an index"),
        (
            '{"format": "x", "version": 1, "shards": [], "skipped": [], "done": 0, "scenes": 0, "per_shard": 1}',
            "expected",
        ),
    ):
        (folder / INDEX).write_text(text)
        with pytest.raises(ValueError, match=f"index.json: .*{words}"):
            check(folder)
    with pytest.raises(ValueError, match="no such folder"):
        check(tmp_path / "nowhere")


def test_no_whole_shard_at_all_is_an_error(tmp_path: Path) -> None:
    folder = written(tmp_path / "shards", scenes=2)
    flip(folder / "shard-00000.tar", 900)
    with pytest.raises(ValueError, match="no shard is complete; the first: .*another checksum"):
        ShardStream(folder)[0]
    assert isinstance(ShardStream(folder, checksums=False)[0], Sample)  # sizes alone do not tell


# Reading


def test_the_order_is_by_seed_covers_an_epoch_and_keeps_scenes_together(tmp_path: Path) -> None:
    folder = written(tmp_path / "shards")
    stream, again = ShardStream(folder, seed=5), ShardStream(folder, seed=5)
    keys = [stream.files(i)[1] for i in range(20)]
    assert keys == [again.files(i)[1] for i in reversed(range(20))][::-1]
    assert sorted(keys[:10]) == sorted(keys[10:]) == [f"{n:06d}_{step:02d}" for n in range(5) for step in range(2)]
    assert keys[:10] != keys[10:] and keys != [ShardStream(folder, seed=6).files(i)[1] for i in range(20)]
    assert all(a[:6] == b[:6] for a, b in zip(keys[::2], keys[1::2], strict=True))
    assert stream[0].asset is stream[1].asset  # encoded once
    with pytest.raises(IndexError):
        stream[-1]


def test_samples_are_those_that_were_written(tmp_path: Path) -> None:
    folder = written(tmp_path / "shards", scenes=2)
    stream = ShardStream(folder)
    assert len(stream) == 4
    for i in range(4):
        key = stream.files(i)[1]
        number, step = int(key[:6]), int(key[7:])
        same(random_sample(10 * number + step, f"object{number}", ("stroke", "text")[step]), stream[i])
        assert isinstance(stream[i].edited, PosedViews)


def test_names_and_kinds_choose(tmp_path: Path) -> None:
    folder = written(tmp_path / "shards")
    stream = ShardStream(folder, names=["object1"], kinds=["text"])
    assert len(stream) == 2 and {(stream[i].name, stream[i].kind) for i in range(2)} == {("object1", "text")}
    with pytest.raises(ValueError, match="holds no samples of the objects and kinds asked for"):
        ShardStream(folder, names=["object7"])


def test_members_carry_no_time_and_no_user(tmp_path: Path) -> None:
    with tarfile.open(written(tmp_path / "shards", scenes=1) / "shard-00000.tar") as tar:
        assert {(m.mtime, m.uid, m.uname, m.isfile()) for m in tar.getmembers()} == {(0, 0, "", True)}
