"""`splatpainter data`: render, check, list, from the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from splattrain.commands.data import SUMMARIES
from splattrain.data.samples import Sample
from splattrain.data.shards import ShardStream, read_index
from tests.support.cli_scenes import Capture, ball, run, saved
from tests.support.data_meshes import write_box

SMALL = ("--size", 24, "--rows", 80, "--surfels", 400, "--samples", 2, "--kinds", "regrade", "relight")


@pytest.fixture()
def meshes(tmp_path: Path) -> Path:
    """Two boxes and a file that is none."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    write_box(folder / "green.glb", (40, 220, 60))
    write_box(folder / "red.glb", (250, 40, 40), (1, 0.5, 0.7))
    (folder / "torn.glb").write_bytes((folder / "red.glb").read_bytes()[:400])
    return folder


def test_the_list_of_commands(capfd: Capture) -> None:
    output = run(capfd, "data")
    assert output.code == 0 and all(f"{name:<7} {line}" in output.out for name, line in SUMMARIES.items())
    assert all(
        run(capfd, "data", name, "--help").out.startswith(f"usage: splatpainter data {name}") for name in SUMMARIES
    )


def test_render_check_and_read(meshes: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "shards"
    done = run(capfd, "data", "render", meshes, "--out", out, *SMALL, "--json")
    assert done.code == 0, done.err
    assert (done.json["samples"], done.json["shards"], done.json["scenes"]) == (4, 1, 3)
    assert sum(done.json["kinds"].values()) == 4
    [skipped] = done.json["skipped"]
    assert skipped["object"] == "torn" and "torn.glb: cannot be read as a mesh" in skipped["reason"]
    healthy = run(capfd, "data", "check", out)
    assert healthy.code == 0 and "all shards are as they were written" in healthy.out
    stream = ShardStream(out)
    samples = [stream[i] for i in range(4)]
    assert {s.name for s in samples} == {"green", "red"} and all(isinstance(s, Sample) for s in samples)
    assert all(np.isfinite(s.novel_after.colors.numpy()).all() and len(s.asset) == 80 for s in samples)
    assert (samples[0].novel_after.colors - samples[0].novel_before.colors).abs().max() > 0.05


def test_it_carries_on_and_two_processes_make_the_same_bytes(meshes: Path, tmp_path: Path, capfd: Capture) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # workers have one, and sums by two have other bits
    assert run(capfd, "data", "render", meshes, "--out", one, *SMALL, "--per-shard", 1, "--scenes", 2).code == 0
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)
    again = run(capfd, "data", "render", meshes, "--out", one, *SMALL, "--per-shard", 1, "--scenes", 4)
    assert (
        again.code == 0 and "2 scenes made, 2 there before" in again.out
    )  # the fourth goes round: green in other light
    words = ("data", "render", meshes, "--out", two, *SMALL, "--per-shard", 1, "--scenes", 4, "--workers", 2)
    assert run(capfd, *words).code == 0
    assert [s["sha256"] for s in read_index(one)["shards"]] == [s["sha256"] for s in read_index(two)["shards"]]
    other = run(capfd, "data", "render", meshes, "--out", one, *SMALL, "--seed", 1)
    assert "holds shards of another run (seed was 0, now 1)" in other.error


def test_check_says_what_is_damaged_and_what_is_missing(meshes: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "shards"
    assert run(capfd, "data", "render", meshes, "--out", out, *SMALL).code == 0
    shard = out / "shard-00000.tar"
    shard.write_bytes(shard.read_bytes()[:-1])
    checked = run(capfd, "data", "check", out)
    assert checked.code == 1 and f"problem  {shard}: has" in checked.out and "cut short" in checked.out


def test_path_traced_truth(meshes: Path, tmp_path: Path, capfd: Capture) -> None:
    pytest.importorskip("mitsuba")
    from splattrain.data.lights import tone_map
    from splattrain.data.records import decode_radiance

    out = tmp_path / "shards"
    words = ("--truth", "path", "--spp", 4, "--linear", "--kinds", "relight", "--samples", 1, "--scenes", 1)
    done = run(capfd, "data", "render", meshes, "--out", out, *SMALL[:6], *words)
    assert done.code == 0, done.err
    stream = ShardStream(out)
    sample, (files, key) = stream[0], stream.files(0)
    assert sample.kind == "relight" and len(sample.edited) >= 1
    assert (sample.novel_before.colors - sample.novel_after.colors).abs().max() > 0.05
    import json

    light = decode_radiance(files, "after", key)
    displayed = tone_map(light, json.loads(files["json"])["exposure"]["after"])
    inside = light.sum(-1) > 0.01
    close = np.abs(displayed - sample.novel_after.colors.numpy()).max(-1) < 0.01
    assert close[inside].mean() > 0.6  # all but the rim, which shows the background too


def test_splat_assets_are_a_source_too(tmp_path: Path, capfd: Capture) -> None:
    folder = tmp_path / "assets"
    folder.mkdir()
    saved(folder / "ball.ply", ball(500))
    listed = run(capfd, "data", "list", folder, "--json")
    assert listed.json["kind"] == "splat assets" and listed.json["objects"][0]["rows"] == 500
    done = run(capfd, "data", "render", folder, "--out", tmp_path / "shards", *SMALL, "--json")
    assert done.code == 0 and set(done.json["kinds"]) == {"regrade"}  # an asset brings its light
    refused = run(capfd, "data", "render", folder, "--out", tmp_path / "other", *SMALL[:6], "--truth", "path")
    assert "path tracing needs meshes" in refused.error


def test_list_shows_objects_reasons_and_the_split(meshes: Path, capfd: Capture) -> None:
    done = run(capfd, "data", "list", meshes, "--share", 0.5)
    assert done.code == 0 and "2 objects (meshes)" in done.out and "12 triangles" in done.out
    assert "skipped" in done.out and "torn.glb: cannot be read as a mesh" in done.out
    names = run(capfd, "data", "list", meshes, "--names-only", "--json").json
    assert [entry["name"] for entry in names["objects"]] == ["green", "red", "torn"] and names["skipped"] == {}
    assert "2 objects (meshes)" in run(capfd, "data", "list", "procedural:2", "--names-only").out


def test_bad_input_is_one_line(meshes: Path, tmp_path: Path, capfd: Capture) -> None:
    out, lights = tmp_path / "shards", tmp_path / "lights"
    lights.mkdir()
    (lights / "dark.hdr").write_bytes(b"#?RADIANCE\n")
    for words, expected in (
        (("data", "paint"), "expected one of render, check, list"),
        (("data", "render", tmp_path / "no", "--out", out), "no such folder"),
        (("data", "render", "procedural:0", "--out", out), "expected procedural:COUNT"),
        (("data", "render", meshes, "--out", out, "--kinds", "magic"), "expected kinds of"),
        (("data", "render", meshes, "--out", out, "--size", 2), "size of at least 16"),
        (("data", "render", meshes, "--out", out, "--surfels", 2000), "no more rows than surfels"),
        (("data", "render", meshes, "--out", out, "--workers", 0), "--workers of at least 1"),
        (("data", "render", meshes, "--out", out, "--scenes", 0), "--scenes of at least 1"),
        (("data", "render", meshes, "--out", out, "--truth", "path", "--kinds", "text"), "expected kinds of relight"),
        (("data", "render", meshes, "--out", out, "--linear"), "--linear needs --truth path"),
        (("data", "render", meshes, "--out", out, "--fonts", tmp_path / "no"), "no such folder"),
        (("data", "check", tmp_path), "index.json: no such file"),
    ):
        assert expected in run(capfd, *words).error, words
    refused = run(capfd, "data", "render", meshes, "--out", out, "--environments", lights)
    assert refused.code == 2 and "holds no environment" in refused.err.splitlines()[-1]
    assert not out.exists()


def test_shards_without_a_sample_are_an_error(meshes: Path, tmp_path: Path, capfd: Capture) -> None:
    """When it is made and when it is started again: a training on them would only say so later."""
    for name in ("green", "red"):
        (meshes / f"{name}.glb").unlink()
    for _ in range(2):
        refused = run(capfd, "data", "render", meshes, "--out", tmp_path / "shards", *SMALL)
        assert refused.code == 2 and "no sample of 1 scene could be made; the last: torn: " in refused.error


@pytest.mark.shared
def test_lights_that_cannot_be_used_are_skipped_with_a_warning(
    shared: Path, meshes: Path, tmp_path: Path, capfd: Capture
) -> None:
    lights = tmp_path / "lights"
    lights.mkdir()
    source = min((shared / "data" / "hdris").glob("*.hdr"), key=lambda path: path.stat().st_size)
    (lights / "good.hdr").write_bytes(source.read_bytes())
    (lights / "cut.hdr").write_bytes(source.read_bytes()[:1000])
    words = ("--environments", lights, "--scenes", 1, "--json")
    done = run(capfd, "data", "render", meshes, "--out", tmp_path / "shards", *SMALL, *words)
    assert done.code == 0 and list(done.json["environments_skipped"]) == ["cut.hdr"]
    assert done.err.startswith("splatpainter: warning: light skipped:") and done.err.count("\n") == 1
