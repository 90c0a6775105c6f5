"""Sources of training objects and the split between training and validation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splattrain.data.object_sources import (
    MeshFolder,
    MeshSource,
    ProceduralSource,
    SplatFolder,
    SplatSource,
    object_seed,
    split,
)

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def test_the_split_depends_on_name_and_seed_alone() -> None:
    names = [f"object {k}" for k in range(2000)]
    train, held = split(names, seed=3, share=0.1)
    assert set(train) | set(held) == set(names) and not set(train) & set(held)
    assert 150 < len(held) < 250  # binomial: mean 200, deviation 13
    assert split(names[::-1], seed=3, share=0.1)[1] == held[::-1]
    more = split([*names, "new"], seed=3, share=0.1)
    assert set(train) <= set(more[0]) and set(held) <= set(more[1])
    assert split(names, seed=4, share=0.1)[1] != held
    assert set(held) <= set(split(names, seed=3, share=0.2)[1])
    assert split(names, share=0)[1] == []
    with pytest.raises(ValueError, match="share"):
        split(names, share=1.0)


def test_a_folder_of_meshes_counts_what_it_skips(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    (tmp_path / "sub").mkdir()
    (tmp_path / "b.obj").write_text(TRIANGLE)
    (tmp_path / "sub" / "a.obj").write_text(TRIANGLE)
    (tmp_path / "bad.glb").write_bytes(b"glTF")
    (tmp_path / "notes.txt").write_text("no mesh")
    source = MeshFolder(tmp_path)
    assert isinstance(source, MeshSource)
    assert [source.name(i) for i in range(len(source))] == ["b", "bad", "sub/a"]
    assert source.mesh(0).name == "b"
    with pytest.raises(ValueError, match="bad.glb"):
        source.mesh(1)
    assert list(source.skipped) == ["bad"] and "bad.glb" in source.skipped["bad"]
    assert [MeshFolder(tmp_path, ["sub/a", "b.obj"]).name(i) for i in range(2)] == ["sub/a", "b"]


@pytest.mark.parametrize("kind", [MeshFolder, SplatFolder])
def test_folders_without_what_is_wanted_are_refused(tmp_path: Path, kind: type) -> None:
    with pytest.raises(ValueError, match="no such folder"):
        kind(tmp_path / "none")
    with pytest.raises(ValueError, match="holds no"):
        kind(tmp_path)
    (tmp_path / "a.obj").write_text(TRIANGLE)
    (tmp_path / "a.ply").write_text("ply")
    with pytest.raises(ValueError, match="'zzz'"):
        kind(tmp_path, ["a", "zzz"])


def test_a_folder_of_splats_reads_assets(tmp_path: Path) -> None:
    from splatpainter.io import write
    from splatpainter.splats import Splats

    splats = Splats(
        np.zeros((2, 3), np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (2, 1)),
        np.full((2, 3), 0.1, np.float32),
        np.full(2, 0.5, np.float32),
        np.zeros((2, 1, 3), np.float32),
    )
    write(tmp_path / "two.ply", splats)
    (tmp_path / "bad.ply").write_bytes(b"ply\n")
    source = SplatFolder(tmp_path)
    assert isinstance(source, SplatSource) and not isinstance(source, MeshSource)
    assert [source.name(i) for i in range(2)] == ["bad.ply", "two.ply"]
    assert len(source.splats(1)) == 2
    with pytest.raises(ValueError):
        source.splats(0)
    assert list(source.skipped) == ["bad.ply"]


def test_procedural_objects_have_lasting_names_and_unrelated_seeds() -> None:
    few, many = ProceduralSource(3, seed=1), ProceduralSource(9, seed=1)
    assert [few.name(i) for i in range(3)] == [many.name(i) for i in range(3)]
    np.testing.assert_array_equal(few.mesh(2).vertices, many.mesh(2).vertices)
    seeds = {object_seed(s, i) for s in range(20) for i in range(20)}
    assert len(seeds) == 400
    with pytest.raises(IndexError):
        few.mesh(3)
    with pytest.raises(ValueError, match="at least one"):
        ProceduralSource(0)
