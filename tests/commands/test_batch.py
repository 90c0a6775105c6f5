"""`splatpainter batch`: the same bytes as the commands one by one, resumed after kills, one bad asset stops nothing."""

from __future__ import annotations

import json
import os
import re
import sqlite3
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

import splatpainter as sp
from splatpainter.batch import schema
from splatpainter.batch.plan import read_jobs
from splatpainter.cameras import Camera
from splatpainter.commands.batch import Config, run_jobs
from splatpainter.commands.batch.work import BatchWork
from splatpainter.operations.grade import Grade
from splatpainter.operations.operation import ReadyOperation, Tools
from splatpainter.painter import Painter
from tests.support.batch_jobs import CAMERA, colored_ball, jobs_file, write_assets
from tests.support.cli_scenes import Capture, listing, run, saved
from tests.support.kill_tests import Killed, Work, attempts

RECOLOR = """\
out: out
assets: [shoes/*.ply]
edits:
  - pictures: {files: ["views/{asset}.png"]}
variants:
  - name: blue
    edits:
      - grade: {recolor: "#2040a0", where: [hue=340..20]}
  - name: plain
"""
GRADES = """\
out: out
assets: [shoes/*.ply]
edits:
  - grade: {exposure: 0.5}
variants:
  - name: blue
    edits:
      - grade: {recolor: "#2040a0", where: [hue=340..20]}
  - name: plain
preview: {size: 32}
"""


@pytest.fixture()
def folder(tmp_path: Path) -> Path:
    write_assets(tmp_path)
    return tmp_path


def summary(folder: Path) -> dict:
    return json.loads((folder / "out" / "summary.json").read_text())


def test_results_are_the_bytes_of_the_commands_one_by_one(folder: Path, capfd: Capture) -> None:
    done = run(capfd, "batch", jobs_file(folder, RECOLOR))
    assert done.code == 0 and done.out.startswith("4 of 4 jobs done\n"), done
    for k in range(2):
        asset, painted, blue = folder / f"shoes/shoe{k}.ply", folder / f"p{k}.ply", folder / f"b{k}.ply"
        assert run(capfd, "edit", asset, folder / f"views/shoe{k}.png", "--out", painted).code == 0
        words = ["--recolor", "#2040a0", "--where", "hue=340..20"]
        assert run(capfd, "grade", painted, *words, "--out", blue).code == 0
        assert (folder / f"out/shoe{k}-plain.ply").read_bytes() == painted.read_bytes()
        assert (folder / f"out/shoe{k}-blue.ply").read_bytes() == blue.read_bytes()
        for variant in ("plain", "blue"):  # each with a receipt from the asset to the result
            assert run(capfd, "verify", asset, folder / f"out/shoe{k}-{variant}.ply").code == 0
    single, alone = (
        json.loads(Path(f"{p}.receipt.json").read_text()) for p in (folder / "out/shoe0-plain.ply", folder / "p0.ply")
    )
    assert {**single, "seconds": 0} == {**alone, "seconds": 0}


def test_the_page_shows_all_and_needs_nothing_else(folder: Path, capfd: Capture) -> None:
    (folder / "shoes" / "<b>.ply").write_bytes(b"ply\nend_header\n")
    assert run(capfd, "batch", jobs_file(folder, GRADES)).code == 1
    page = (folder / "out" / "index.html").read_text()
    assert page.count("data:image/webp;base64,") == 8 and "shoe1-blue.ply.receipt.json" in page
    assert "<b>" not in page and "&lt;b&gt;-plain" in page and "2 failed" in page
    assert not re.findall(r"(?:src|href)=\"(?!data:)[^\"]*//", page) and "script" not in page


def test_one_bad_asset_stops_nothing_and_the_exit_code_says_it(folder: Path, capfd: Capture) -> None:
    (folder / "shoes" / "shoe2.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\n")
    (folder / "views" / "shoe1.png").unlink()
    done = run(capfd, "batch", jobs_file(folder, RECOLOR), "--json")
    assert done.code == 1 and done.json["done"] == 2 and done.json["failed"] == 4
    errors = {job["name"]: job["error"] for job in done.json["jobs"] if job["status"] == "failed"}
    assert errors["shoe1-blue"].startswith(f"{folder / 'jobs.yaml'}:4: {folder / 'views/shoe1.png'}: no such file")
    assert errors["shoe2-plain"].startswith(f"{folder / 'jobs.yaml'}:4: {folder / 'views/shoe2.png'}: no such file")
    assert summary(folder)["failed"] == 4 and (folder / "out" / "shoe0-blue.ply").exists()
    assert run(capfd, "batch", jobs_file(folder, GRADES)).code == 1
    assert "vertex" in next(job["error"] for job in summary(folder)["jobs"] if job["name"] == "shoe2-plain")


def test_what_is_done_is_not_done_again(folder: Path, capfd: Capture) -> None:
    jobs = jobs_file(folder, GRADES)
    assert run(capfd, "batch", jobs, "--dry-run").out.endswith("4 of 4 jobs to do\n")
    assert run(capfd, "batch", jobs).code == 0
    before = listing(folder / "out" / "jobs")
    times = {path: path.stat().st_mtime_ns for path in (folder / "out").glob("*.ply*")}
    assert run(capfd, "batch", jobs, "--dry-run").out.endswith("0 of 4 jobs to do\n")
    assert run(capfd, "batch", jobs).out.startswith("4 of 4 jobs done, 4 of them there before\n")
    assert listing(folder / "out" / "jobs") == before
    assert {path: path.stat().st_mtime_ns for path in times} == times
    # another result, another asset, another edit: these and no others
    (folder / "out" / "shoe0-plain.ply").write_bytes(b"")
    saved(folder / "shoes" / "shoe1.ply", colored_ball(600, 7))
    done = run(capfd, "batch", jobs, "--json")
    assert [job["resumed"] for job in done.json["jobs"]] == [True, False, False, False]
    changed = jobs_file(folder, GRADES.replace("#2040a0", "#20a040"))
    done = run(capfd, "batch", changed, "--json")
    assert [job["resumed"] for job in done.json["jobs"]] == [False, True, False, True]


def test_a_step_that_was_finished_before_a_kill_is_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second edit of a job dies as if by a kill; then only that one is made."""
    jobs = read_jobs(jobs_file(folder, GRADES)).jobs[:1]
    real, calls = Grade.ready, []

    def killed(operation: Grade, tools: Tools) -> ReadyOperation:
        calls.append(operation.recolor)
        if operation.recolor and len(calls) == 2:
            (jobs[0].folder / ".7.part.result.ply").write_bytes(b"half")
            raise KeyboardInterrupt
        return real(operation, tools)

    monkeypatch.setattr(Grade, "ready", killed)
    with pytest.raises(KeyboardInterrupt):
        BatchWork(jobs)(0)
    assert BatchWork(jobs)(0)["status"] == "done" and calls == ["", "#2040a0", "#2040a0"]
    assert sorted(path.name for path in jobs[0].folder.iterdir()) == ["after.webp", "before.webp", "record.json"]


def test_a_projects_layers_on_another_asset(folder: Path, capfd: Capture) -> None:
    with sp.Session(folder / "shoes" / "shoe0.ply", folder / "brand.splatproj", painter=Painter()) as session:
        picture = sp.render(session.splats, CAMERA).colors[0].copy()
        picture[40:50, 40:56] = (0.1, 0.6, 0.2)
        session.layers.add("paint", [sp.Edit(picture, CAMERA)], name="stripe")
        session.layers.add("look", look="grade", settings={"exposure": -0.5}, name="darker")
        hidden = session.layers.add("look", look="grade", settings={"exposure": 3.0}, name="hidden")
        session.layers.set(hidden.id, visible=False)
        session.files.export(folder / "expected.ply")
    jobs_file(folder, "assets: [shoes/shoe0.ply]\nedits: [{layers: {project: brand.splatproj}}]\n")
    assert run(capfd, "batch", folder / "jobs.yaml").code == 0
    assert (folder / "out/shoe0.ply").read_bytes() == (folder / "expected.ply").read_bytes()
    jobs_file(folder, "assets: [shoes/shoe0.ply]\nedits: [{layers: {project: brand.splatproj, only: [logo]}}]\n")
    assert "expected visible layers, got none called logo" in run(capfd, "batch", folder / "jobs.yaml").out


def test_a_decal_in_another_format(folder: Path, capfd: Capture) -> None:
    decal = "{picture: label.png, camera: cam.json, at: [48, 48], width: 20%}"
    text = f"assets: [shoes/shoe1.ply]\nformat: spz\nedits: [{{decal: {decal}}}]\n"
    assert run(capfd, "batch", jobs_file(folder, text)).code == 0
    words = ["--decal", folder / "label.png", "--camera", folder / "cam.json", "--at", "48,48", "--width", "20%"]
    assert run(capfd, "edit", folder / "shoes/shoe1.ply", *words, "--out", folder / "d.spz").code == 0
    assert (folder / "out/shoe1.spz").read_bytes() == (folder / "d.spz").read_bytes()


def counted_source(folder: Path) -> dict:
    """The keys of a `source` that paints by a program, which appends its prompt to the file `calls`."""
    program = folder / "paint.py"
    program.write_text(
        "import sys; from PIL import Image\n"
        "picture = Image.open(sys.argv[1]).convert('RGB')\n"
        "picture.paste((20, 120, 40), (36, 40, 60, 58)); picture.save(sys.argv[2])\n"
        f"open({str(folder / 'calls')!r}, 'a').write(sys.argv[3] + ' ')\n"
    )
    run_option = f"{sys.executable} {program} {{image}} {{out}} {{prompt}}"
    return {"name": "command", "prompt": "moss on {asset}", "options": {"run": run_option}, "view": "cam.json"}


def test_pictures_of_a_source_are_asked_for_once(folder: Path, capfd: Capture) -> None:
    """A program paints; the edit after it fails, and later the program is not asked again."""
    source = counted_source(folder)
    run_option = source["options"]["run"]
    edits = [{"source": source}, {"grade": {"lut": "{asset}.cube"}}]
    jobs = jobs_file(folder, json.dumps({"assets": ["shoes/shoe0.ply"], "edits": edits}))
    (folder / "shoe0.cube").write_text("LUT_1D_SIZE 2\n0 0 0\n")
    assert run(capfd, "batch", jobs, "--dry-run").out.endswith("1 of 1 job to do: 1 free call\n")
    assert not (folder / "calls").exists()
    assert "expected 2 entries" in run(capfd, "batch", jobs).out
    (folder / "shoe0.cube").write_text("LUT_1D_SIZE 2\n1 1 1\n0 0 0\n")
    assert run(capfd, "batch", jobs).code == 0
    assert (folder / "calls").read_text() == "moss on shoe0 "
    words = ["--source", "command", "--prompt", "moss on shoe0", "--source-option", f"run={run_option}"]
    words += ["--view", str(folder / "cam.json")]
    painted, out = folder / "painted.ply", folder / "negative.ply"
    assert run(capfd, "edit", folder / "shoes/shoe0.ply", *words, "--out", painted).code == 0
    assert run(capfd, "grade", painted, "--lut", folder / "shoe0.cube", "--out", out).code == 0
    assert out.read_bytes() == (folder / "out/shoe0.ply").read_bytes()


def test_what_variants_have_in_common_is_asked_for_once(folder: Path, capfd: Capture) -> None:
    source = counted_source(folder)
    variants = [{"name": f"v{k}", "edits": [{"grade": {"exposure": k}}]} for k in (1, 2)]
    batch = {"assets": ["shoes/shoe0.ply"], "edits": [{"source": source}], "variants": [*variants, {"name": "plain"}]}
    jobs = jobs_file(folder, json.dumps(batch))
    assert run(capfd, "batch", jobs, "--dry-run").out.endswith("3 of 3 jobs to do: 1 free call\n")
    (folder / "out").mkdir()
    (folder / "out" / "shoe0-v2.ply").write_bytes(b"mine")  # this job fails, and is made later
    assert run(capfd, "batch", jobs).code == 1
    assert run(capfd, "batch", jobs, "--dry-run").out.endswith("1 of 3 jobs to do\n")
    (folder / "out" / "shoe0-v2.ply").unlink()
    assert run(capfd, "batch", jobs).code == 0 and (folder / "calls").read_text() == "moss on shoe0 "
    assert not (folder / "out" / "jobs" / ".common").exists()
    graded = folder / "graded.ply"
    assert run(capfd, "grade", folder / "out/shoe0-plain.ply", "--exposure", 2, "--out", graded).code == 0
    assert graded.read_bytes() == (folder / "out/shoe0-v2.ply").read_bytes()
    source["prompt"] = "moss on {variant}"
    jobs = jobs_file(folder, json.dumps({**batch, "out": "each"}))
    assert run(capfd, "batch", jobs, "--dry-run").out.endswith("3 of 3 jobs to do: 3 free calls\n")


def test_what_variants_have_in_common_fails_once(folder: Path, capfd: Capture) -> None:
    """A picture that is refused was paid for: not by every variant, and a dry run counts no calls of a broken asset."""
    source = counted_source(folder) | {"size": 64, "strictness": "strict"}
    (folder / "paint.py").write_text((folder / "paint.py").read_text().replace("picture.paste((20, 120, 40), ", "("))
    variants = [{"name": f"v{k}", "edits": [{"grade": {"exposure": k}}]} for k in (1, 2)]
    batch = {"assets": ["shoes/shoe0.ply"], "edits": [{"source": source}], "variants": variants}
    jobs = jobs_file(folder, json.dumps(batch))
    for calls in (1, 2):  # another run asks again
        done = run(capfd, "batch", jobs, "--json").json
        assert done["failed"] == 2 and (folder / "calls").read_text() == calls * "moss on shoe0 "
        assert all("came back unchanged" in job["error"] for job in done["jobs"])
        saved_picture = Path(done["jobs"][1]["error"].rsplit(" ", 1)[-1])
        assert (
            saved_picture.name.endswith(f".answer_{calls}.png")
            and saved_picture.is_file()
            and folder in saved_picture.parents
        )
    (folder / "shoes/shoe0.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\n")
    dry = run(capfd, "batch", jobs, "--dry-run", "--json")
    assert dry.code == 1 and [job["state"] for job in dry.json["jobs"]] == ["fails", "fails"]


def test_views_are_refined(folder: Path, capfd: Capture) -> None:
    camera = Camera.from_json((folder / "cam.json").read_text())
    (folder / "small.json").write_text(camera.resized(40, 40).to_json())
    text = "assets: [shoes/shoe0.ply]\nedits: [{refine: {views: [small.json]}}]\n"
    jobs = jobs_file(folder, text)
    assert run(capfd, "batch", jobs, "--dry-run", "--json").json["free_calls"] == 1
    assert run(capfd, "batch", jobs).code == 0
    words = ["--view", folder / "small.json", "--out", folder / "r.ply"]
    assert run(capfd, "refine", folder / "shoes/shoe0.ply", *words).code == 0
    assert (folder / "out/shoe0.ply").read_bytes() == (folder / "r.ply").read_bytes()


def test_nothing_is_replaced_that_no_batch_made(folder: Path, capfd: Capture) -> None:
    (folder / "out").mkdir()
    (folder / "out" / "shoe0-plain.ply").write_bytes(b"mine")
    done = run(capfd, "batch", jobs_file(folder, GRADES))
    assert done.code == 1 and "shoe0-plain.ply: already exists, and no batch made it" in done.out
    assert (folder / "out" / "shoe0-plain.ply").read_bytes() == b"mine"
    assert run(capfd, "batch", folder / "jobs.yaml", "--overwrite").code == 0
    assert (folder / "out" / "shoe0-plain.ply").read_bytes() != b"mine"


def test_two_batches_do_not_write_into_one_folder(folder: Path, capfd: Capture) -> None:
    from splatpainter.session.project.lock import ProjectLock

    (folder / "out").mkdir()
    lock = ProjectLock.take(folder / "out" / ".batch")
    assert lock is not None
    assert "another batch is writing there" in run(capfd, "batch", jobs_file(folder, GRADES)).error
    lock.release()


def test_a_batch_that_cannot_lock_its_folder_leaves_none(
    folder: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a disk that refuses locks an empty folder stayed."""
    from splatpainter.session.project import lock

    def refused(*_: object, **__: object) -> None:
        raise sqlite3.OperationalError("disk I/O error")

    monkeypatch.setattr(lock.sqlite3, "connect", refused)
    jobs = jobs_file(folder, GRADES)
    before = sorted(folder.rglob("*"))
    done = run(capfd, "batch", jobs)
    assert done.code == 2 and "cannot be locked (disk I/O error)" in done.error and "\n" not in done.error
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    "text, line",
    [
        ("assets: [shoes/*.ply]\n", ":1: expected edits"),
        ("assets: []\nedits: [{grade: {exposure: 1}}]\n", ":1: expected at least one of assets"),
        ("assets: [a.ply]\nedits: [{grade: {exposure: 1}}]\n", ":1: {folder}/a.ply: no such file"),
        (
            "assets:\n  - shoes/*.ply\n  - hats/*.ply\nedits: [{grade: {exposure: 1}}]\n",
            ":3: hats/*.ply: no splat file has such",
        ),
        ("assets: [cam.json]\nedits: [{grade: {exposure: 1}}]\n", ":1: {folder}/cam.json: expected a splat file"),
        ("assets: [shoes/*.ply]\nedits:\n  - grde: {}\n", ":3: unknown key 'edits[0].grde'; known there: pictures, "),
        ("assets: [shoes/*.ply]\nedits:\n  - grade: {exposure: warm}\n", ":3: expected float as 'edits[0].grade.exp"),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade: {}\n",
            ":3: edits[0].grade: expected sliders or one look",
        ),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade: {exposure: 99}\n",
            ":3: edits[0].grade: expected exposure from -10",
        ),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade: {recolor: navy}\n",
            ":3: edits[0].grade: expected recolor like #20",
        ),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade: {recolor: '#2040a0', where: [hu=3..5]}\n",
            ":3: edits[0].grade: --where: expected NAME=VALUE with one of hue,",
        ),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade: {recolor: #2040a0}\n",
            ":4: is not YAML (expected the node content, but found '<stream end>'); line 3: # begins a comment, put",
        ),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade:\n      recolor: #2040a0\n",
            ":4: expected str as 'edits[0].grade.recolor', got None; line 4: # begins a comment, put",
        ),
        ("assets: [shoes/*.ply]\nedits:\n  - {}\n", ":3: edits[0]: expected one of pictures, decal, grade, source"),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade:\n      lut: film.cube\n",
            ":4: {folder}/film.cube: no such file",
        ),
        (
            "assets: [shoes/*.ply]\nedits:\n  - grade:\n      exposure: 1\n      where:\n        - x=0..\n"
            "        - not:mask=m.png@cam.json\n",
            ":7: {folder}/m.png: no such file",
        ),
        (
            "assets: [shoes/*.ply]\nedits: [{grade: {exposure: 1}}]\nvariants:\n  - name: a/b\n",
            ":4: variants[0]: expected a name of letters, digits, space and .+-_, got 'a/b'",
        ),
        (
            "assets: [shoes/*.ply]\nedits: [{grade: {exposure: 1}}]\nvariants: [{name: a}, {name: A}]\n",
            ":1: variants: 'a' was given twice",
        ),
        (
            "assets: [shoes/*.ply]\nout: shoes\nedits: [{grade: {exposure: 1}}]\n",
            ":1: {folder}/shoes/shoe0.ply would be",
        ),
        ("assets: [shoes/*.ply]\nedits: [{grade: {exposure: 1}}]\npreview: {size: 9}\n", ":3: preview: expected size"),
        (
            "assets: [shoes/*.ply]\nedits:\n  - decal: {camera: cam.json, at: [1, 2], width: 3}\n",
            ":3: edits[0].decal: expected picture or text",
        ),
        (
            "assets: [shoes/*.ply]\nedits:\n  - decal: {camera: cam.json, at: [1], width: 3, text: a}\n",
            ":3: expected 2 values as 'edits[0].decal.at', got a list of 1",
        ),
    ],
)
def test_a_wrong_file_is_one_line_with_its_place(folder: Path, capfd: Capture, text: str, line: str) -> None:
    jobs = jobs_file(folder, text)
    before = listing(folder)
    done = run(capfd, "batch", jobs)
    assert done.error.startswith(f"splatpainter: {jobs}{line.replace('{folder}', str(folder))}"), done.err
    assert listing(folder) == before


def test_the_example_of_the_guide_is_a_batch(folder: Path) -> None:
    """And the guide names every key."""
    guide = (Path(__file__).parents[2] / "docs" / "guide" / "batch.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", guide, re.S)
    for name in ("logo.png", "side.json", "autumn.jpg"):
        (folder / name).write_bytes(b"")
    jobs = read_jobs(jobs_file(folder, example)).jobs
    assert [job.name for job in jobs[:3]] == ["shoe0-blue", "shoe0-autumn", "shoe0-plain"] and len(jobs) == 6
    for kind in (schema.Batch, schema.Variant, schema.Preview, schema.JobEdit, *schema.STEPS.values()):
        assert not [field.name for field in fields(kind) if f"`{field.name}`" not in guide], kind  # pyright: ignore[reportArgumentType]


def test_assets_of_one_name_take_that_of_their_folder(folder: Path) -> None:
    for name in ("a", "b"):
        (folder / name).mkdir()
        (folder / name / "model.ply").write_bytes((folder / "shoes" / "shoe0.ply").read_bytes())
    (folder / "b" / "other.compressed.ply").write_bytes(b"")
    text = "assets: ['[ab]/*.ply', shoes/shoe0.ply, shoes/*.ply]\nedits: [{grade: {exposure: 1}}]\n"
    names = [(job.name, job.out.name) for job in read_jobs(jobs_file(folder, text)).jobs]
    assert names == [
        ("a-model", "a-model.ply"),
        ("b-model", "b-model.ply"),
        ("other", "other.compressed.ply"),
        ("shoe0", "shoe0.ply"),
        ("shoe1", "shoe1.ply"),
    ]


# Workers


@pytest.fixture()
def workers_find_this_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    root = str(Path(__file__).parents[2])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("PYTHONWARNINGS", "ignore")


def test_a_pool_makes_what_one_process_makes(folder: Path, capfd: Capture, workers_find_this_folder: None) -> None:
    text = GRADES.replace("*", "shoe0")
    assert run(capfd, "batch", jobs_file(folder, text.replace("out: out", "out: alone"))).code == 0
    assert run(capfd, "batch", jobs_file(folder, text), "--workers", "2").code == 0
    for name in ("shoe0-blue.ply", "shoe0-plain.ply"):
        assert (folder / "out" / name).read_bytes() == (folder / "alone" / name).read_bytes()


@pytest.fixture()
def local_ray() -> Iterator[None]:
    pytest.importorskip("ray", reason="no Ray: install splatpainter[cluster]")
    yield
    import ray

    assert not ray.is_initialized()


@pytest.mark.filterwarnings("ignore")  # of Ray's own
@pytest.mark.slow
def test_ray_with_two_workers_one_killed(folder: Path, workers_find_this_folder: None, local_ray: None) -> None:
    """Two processes of a local Ray; the one that makes job 1 is killed in the middle, and the job is made again. Slow:
    Ray starts, and each worker loads the kernels."""
    plans = [read_jobs(jobs_file(folder, GRADES.replace("*", "shoe0").replace("out: out", f"out: {k}"))) for k in "ab"]
    (folder / "seen").mkdir()
    work = Killed(Work(str(folder / "seen"), dies_once=1), BatchWork(plans[0].jobs))
    records = run_jobs(work, plans[0].jobs, Config(plans[0].file, workers=2, ray=()))
    assert [record["status"] for record in records] == ["done", "done"], records
    assert attempts(folder / "seen", 1) == 2
    alone = run_jobs(BatchWork(plans[1].jobs), plans[1].jobs, Config(plans[1].file))
    assert all(record["status"] == "done" for record in alone)
    for one, other in zip(plans[0].jobs, plans[1].jobs, strict=True):
        assert one.out.read_bytes() == other.out.read_bytes()
