"""`render`: kinds in and out, checks at the door, and what it does not import."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import splatpainter as sp
import splatpainter.rendering
from splatpainter.kernels import parallel
from tests.support.render_scenes import cameras, scene, with_odd_gaussians


def run(script: str) -> subprocess.CompletedProcess:
    """A fresh interpreter, because this one has imported everything."""
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)


def test_the_public_function_is_the_package_s():
    splats, view = scene(10, 0), cameras(16, 16)[0]
    assert sp.render is splatpainter.rendering.render
    assert sp.render(splats, [view]).colors.shape == (1, 16, 16, 3)


def test_numpy_path_needs_no_torch():
    result = run(
        "import sys, numpy as np, splatpainter as sp, splatpainter.rendering\n"
        "v = np.full((3, 3), 0.3, np.float32)\n"
        "s = sp.Splats(v, np.ones((3, 4), np.float32), v, v[:, 0], v[:, None])\n"
        "r = sp.render(s, sp.look_at([0, 0, 3], [0, 0, 0], width=32, height=32), contributions=True)\n"
        "assert r.alphas.max() > 0 and r.contributions.min() > 0\n"
        "assert 'torch' not in sys.modules, 'torch was imported'\n"
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this platform")
def test_a_forked_child_draws_too():
    """Data loaders fork after the parent has drawn: the parent's worker threads do not exist in the child."""
    result = run(
        "import os, numpy as np, splatpainter as sp\n"
        "os.environ['SPLATPAINTER_THREADS'] = '2'\n"
        "v = np.full((3, 3), 0.3, np.float32)\n"
        "s = sp.Splats(v, np.ones((3, 4), np.float32), v, v[:, 0], v[:, None])\n"
        "draw = lambda: sp.render(s, sp.look_at([0, 0, 3], [0, 0, 0], width=32, height=32)).colors\n"
        "before = draw()\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    os._exit(0 if (draw() == before).all() else 3)\n"
        "assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0\n"
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_kind_and_dtype_come_back(dtype):
    splats, views = scene(10, 1, dtype=dtype), cameras(20, 12, count=2)
    arrays = sp.render(splats, views, contributions=True)
    assert isinstance(arrays.colors, np.ndarray) and arrays.colors.dtype == dtype
    assert (arrays.alphas.shape, arrays.depths.shape) == ((2, 12, 20, 1), (2, 12, 20, 1))
    assert sp.render(splats, views).contributions is None
    tensors = sp.render(splats.torch(dtype=getattr(torch, np.dtype(dtype).name)), views, contributions=True)
    for name in ("colors", "alphas", "depths", "contributions"):
        assert isinstance(getattr(tensors, name), torch.Tensor)
        np.testing.assert_array_equal(getattr(tensors, name).numpy(), getattr(arrays, name))


def test_background():
    splats, views = scene(10, 1), cameras(20, 12, count=2)
    over_background = sp.render(splats, views)
    one = sp.render(splats, views, background=[1, 0, 0.5])
    each = sp.render(splats, views, background=np.array([[1, 0, 0.5], [0, 1, 0]]))
    clear = 1 - over_background.alphas
    black = over_background.colors - clear * np.array([view.background for view in views])[:, None, None]
    np.testing.assert_allclose(one.colors, black + clear * [1, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(each.colors[1], black[1] + clear[1] * [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"opacities": np.zeros((10, 1))}, r"expected opacities \[10\], got \[10, 1\]"),
        ({"quats": np.zeros((9, 4))}, r"expected quats \[10, 4\], got \[9, 4\]"),
        ({"sh": np.zeros((10, 5, 3))}, r"expected sh \[N, 1, 4, 9, 16 or 25, 3\], got \[10, 5, 3\]"),
        ({"scales": np.zeros((10, 3), np.float32)}, r"all float64\) attributes, got scales as float32"),
        ({"means": np.zeros((10, 3), np.int64)}, "got means as int64"),
        ({"scales": torch.zeros(10, 3)}, "attributes of one kind, got scales as Tensor"),
    ],
)
def test_wrong_splats(change, message):
    with pytest.raises(ValueError, match=message) as error:
        sp.render(replace(scene(10, 1), **change), cameras(16, 16))
    assert "\n" not in str(error.value)


def test_wrong_arguments(monkeypatch):
    splats, view = scene(10, 0), cameras(16, 16)[0]
    with pytest.raises(ValueError, match="at least one camera"):
        sp.render(splats, [])
    with pytest.raises(ValueError, match="cameras of one size, got 16x16, 17x16"):
        sp.render(splats, [view, replace(view, width=17)])
    with pytest.raises(ValueError, match=r"background of shape \[3\] or \[1, 3\], got \[4\]"):
        sp.render(splats, view, background=[0, 0, 0, 1])
    with pytest.raises(ValueError, match="expected a backend of auto, cpu, cuda, reference, got 'gpu'"):
        sp.render(splats, view, backend="gpu")  # pyright: ignore[reportArgumentType]
    monkeypatch.setenv(parallel.THREADS_VARIABLE, "two")
    with pytest.raises(ValueError, match="SPLATPAINTER_THREADS: expected a positive integer, got 'two'"):
        sp.render(splats, view)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_without_a_device_says_so_in_one_line():
    with pytest.raises(ValueError, match="needs an NVIDIA GPU") as error:
        sp.render(scene(10, 0), cameras(16, 16), backend="cuda")
    assert "\n" not in str(error.value)


def test_cuda_adapter_on_a_stand_in(monkeypatch):
    """What goes to gsplat and what comes back, without a GPU: its `rasterization` is made of the reference's parts."""
    from splatpainter.rendering import cuda, reference

    def rasterization(means, quats, scales, opacities, colors, *, viewmats, Ks, width, height, sh_degree, **options):
        assert options["near_plane"] == 0.01 and options["eps2d"] == 0.3 and not options["packed"]
        pictures = []
        for c, (matrix, k) in enumerate(zip(viewmats, Ks, strict=True)):
            fx, fy, cx, cy = (float(k[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
            view = sp.Camera(width, height, fx, fy, cx, cy, matrix.double().numpy())
            sh = colors if sh_degree is not None else torch.zeros(len(means), 1, 3)
            gaussians = sp.Splats(means, quats, scales, opacities, sh, options["rasterize_mode"] == "antialiased")
            alpha, z, color, order = reference.project(gaussians, view)
            weight, left = reference.composite(alpha)
            picture = weight.T @ (color if sh_degree is not None else colors[c][order])
            distance = (weight.T @ z) / (1 - left).clamp_min(1e-10)
            pictures.append(torch.cat([picture, distance[:, None], 1 - left[:, None]], 1).reshape(height, width, 5))
        stack = torch.stack(pictures)
        return stack[..., : 4 if options["render_mode"] == "RGB+ED" else 3], stack[..., 4:], {}

    monkeypatch.setattr(cuda, "require", lambda: rasterization)
    views = cameras(24, 20, count=2)
    behind = torch.tensor([[0.1, 0.5, 0.9], [0.3, 0.2, 0.1]])
    for antialiased in (False, True):
        splats = with_odd_gaussians(scene(40, 2, 3, dtype=np.float32, antialiased=antialiased)).torch()
        drawn = cuda.draw(splats, views, behind, True)
        expected = sp.render(splats, views, background=behind, backend="reference", contributions=True)
        names = ("colors", "alphas", "depths", "contributions")
        for name, value in zip(names, drawn, strict=True):
            np.testing.assert_allclose(np.asarray(value), getattr(expected, name), 1e-4, 1e-4, err_msg=name)
    nothing = cuda.draw(splats.take(torch.arange(3)), views, behind, True)
    np.testing.assert_array_equal(nothing[0][1, 3, 3], behind[1])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: gsplat is not compared")
def test_cuda_matches_the_cpu():
    splats = scene(200, 2, 3, dtype=np.float32)
    for each in (splats, replace(splats, antialiased=True)):
        ours = sp.render(each, cameras(64, 48, count=2), contributions=True)
        theirs = sp.render(each, cameras(64, 48, count=2), backend="cuda", contributions=True)
        for name in ("colors", "alphas", "contributions"):
            np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), rtol=1e-3, atol=5e-3, err_msg=name)
