"""Work on other processes: a worker killed in the middle costs a retry, and nothing else."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatpainter.batch.cluster import LostTask, run_here, run_in_pool, run_on_ray
from splattrain.data.jobs import RenderJob, render_scene
from splattrain.data.samples import SampleRecipe
from splattrain.data.shards import RenderedScene, ShardWriter, check
from tests.support.data_meshes import write_box
from tests.support.kill_tests import Killed, Work, attempts

SQUARES = {n: n * n for n in range(5)}


@pytest.fixture(autouse=True)
def workers_find_this_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    )
    monkeypatch.setenv("PYTHONWARNINGS", "ignore")


def test_work_here_and_in_a_pool_comes_back_numbered(tmp_path: Path) -> None:
    assert dict(run_here(Work(str(tmp_path)), range(5))) == SQUARES
    assert dict(run_in_pool(Work(str(tmp_path)), range(5), 2)) == SQUARES
    assert dict(run_in_pool(Work(str(tmp_path)), [], 2)) == {}


def test_a_killed_worker_of_the_pool_costs_a_retry(tmp_path: Path) -> None:
    done = dict(run_in_pool(Work(str(tmp_path), dies_once=1), range(5), 2))
    assert done == SQUARES
    assert attempts(tmp_path, 1) == 2 and attempts(tmp_path, 4) == 1


def test_work_that_kills_every_worker_is_lost_and_the_rest_is_not(tmp_path: Path) -> None:
    done = dict(run_in_pool(Work(str(tmp_path), dies_always=2), range(4), 1, retries=2))
    assert done.pop(2) == LostTask("its worker died 3 times (killed, or out of memory)")
    assert done == {n: n * n for n in (0, 1, 3)} and attempts(tmp_path, 2) == 3


def test_cancelled_work_ends_with_its_workers(tmp_path: Path) -> None:
    """The second piece of work never ends by itself."""
    results = run_in_pool(Work(str(tmp_path), hangs=1), range(3), 1, cancelled=lambda: bool(attempts(tmp_path, 1)))
    assert list(results) in ([], [(0, 0)])
    for _ in range(600):  # not join: the pool's own thread may be waiting for the process at the same time
        if not multiprocessing.active_children():
            return
        time.sleep(0.1)
    pytest.fail(f"still at work: {multiprocessing.active_children()}")


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    program = (
        "import sys; from splatpainter.batch.cluster import run_in_pool; from tests.support.kill_tests import Work\n"
        "list(run_in_pool(Work(sys.argv[1], hangs=0), range(1), 1))"
    )
    parent = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE)
    for _ in range(600):
        if attempts(tmp_path, 0):
            break
        time.sleep(0.1)
    assert attempts(tmp_path, 0) == 1
    parent.kill()
    parent.communicate(timeout=60)  # ends when nobody holds its stdout any more


def test_an_error_of_the_work_itself_is_raised(tmp_path: Path) -> None:
    for run in (run_here, partial(run_in_pool, workers=1)):
        with pytest.raises(ValueError, match="^0: is unlucky$"):
            list(run(Work(str(tmp_path), fails=0), range(3)))


# Ray


@pytest.fixture()
def local_ray() -> Iterator[None]:
    pytest.importorskip("ray", reason="no Ray: install splatpainter[cluster]")
    yield
    import ray

    assert not ray.is_initialized()  # ended by who started it


@pytest.mark.filterwarnings("ignore")  # of Ray's own
@pytest.mark.slow
def test_ray_with_two_workers_one_killed_fills_the_shards(tmp_path: Path, local_ray: None) -> None:
    """Two processes; the worker that makes scene 1 is killed (SIGKILL) in the middle of it. Scene 1 is made again, the
    shards are whole, and equal to what one process makes."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for k, color in enumerate([(250, 40, 40), (40, 200, 60), (30, 60, 250)]):
        write_box(meshes / f"box{k}.glb", color, (1, 0.6 + 0.2 * k, 0.8))
    recipe = SampleRecipe(
        {"regrade": 1.0}, size=16, rows=60, surfels=300, steps_per_object=1, base_views=1, novel_views=1
    )
    job = RenderJob(str(meshes), recipe)
    (tmp_path / "seen").mkdir()
    work = Killed(Work(str(tmp_path / "seen"), dies_once=1), partial(render_scene, job))
    with ShardWriter(tmp_path / "ray", job.spec(), 3, 2) as writer:
        for number, scene in run_on_ray(work, writer.missing(), workers=2):
            assert isinstance(scene, RenderedScene), scene
            writer.add(number, scene)
    assert attempts(tmp_path / "seen", 1) == 2 and attempts(tmp_path / "seen", 0) == 1
    with ShardWriter(tmp_path / "alone", job.spec(), 3, 2) as writer:
        for number in writer.missing():
            writer.add(number, render_scene(job, number))
    for name in ("shard-00000.tar", "shard-00001.tar", "index.json"):
        assert (tmp_path / "ray" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    health = check(tmp_path / "ray")
    assert health.complete and health.samples == 3 and health.skipped == 0


def test_without_ray_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install 'splatpainter\[cluster\]'"):
        list(run_on_ray(Work(str(tmp_path)), range(2)))


@pytest.mark.parametrize("address", ["127.0.0.1:9", "ray://127.0.0.1:9", "127.0.0.1:many"])
def test_an_address_where_nobody_answers_is_one_line(
    address: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace())
    with pytest.raises(ValueError, match=f"^--ray: {address} cannot be reached"):
        list(run_on_ray(Work(str(tmp_path)), range(2), address))
