"""Light: pictures in, spherical harmonics against brute force, shading against the written-out sums, tone map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.lighting import unoccluded_transfer
from splatpainter.lights import sky_maps
from splatpainter.splats import SH_C0
from splatpainter.transforms import sh_basis
from splattrain.data.environments import encode_exr, load_environment
from splattrain.data.lights import (
    auto_exposure,
    equirectangular,
    irradiance,
    make_light,
    mirrored_sh,
    project_sh,
    random_light,
    shade,
    shade_all,
    tone_map,
    uniform_light,
)
from splattrain.data.surfels import Surfels


def directions(count: int, seed: int = 0) -> torch.Tensor:
    d = torch.from_numpy(np.random.default_rng(seed).standard_normal((count, 3)))
    return d / d.norm(dim=1, keepdim=True)


def surfels(normals: torch.Tensor, **values: float) -> Surfels:
    """Open surfels with given normals; albedo, metallic, roughness by keyword."""
    n = len(normals)
    look = {"albedo": 0.5, "metallic": 0.0, "roughness": 0.6, "occlusion": 1.0} | values
    normals = normals.float()
    return Surfels(
        means=torch.zeros(n, 3),
        normals=normals,
        quats=torch.zeros(n, 4),
        scales=torch.ones(n, 3),
        opacities=torch.ones(n),
        albedo=torch.full((n, 3), look["albedo"]),
        metallic=torch.full((n,), look["metallic"]),
        roughness=torch.full((n,), look["roughness"]),
        occlusion=torch.full((n,), look["occlusion"]),
        transfer=torch.from_numpy(unoccluded_transfer(normals.numpy())),
    )


def seen(sh: torch.Tensor, towards: torch.Tensor) -> torch.Tensor:
    """[N, 3] colour in directions [N, 3] from the camera to the Gaussian, as the renderer computes it."""
    return 0.5 + torch.einsum("nkc,nk->nc", sh, sh_basis(towards.float(), 2)[:, : sh.shape[1]])


def test_the_basis_is_orthonormal_and_the_same_in_numpy_torch_and_the_renderer() -> None:
    from splatpainter.cameras import look_at
    from splatpainter.rendering import render
    from splatpainter.splats import Splats

    towards, area = equirectangular(256, 512, dtype=torch.float64)
    assert float(area.sum() * 512) == pytest.approx(4 * np.pi, rel=1e-12)
    y = sh_basis(towards, 2)
    gram = torch.einsum("hwk,hwl->kl", y * area[..., None], y)
    torch.testing.assert_close(gram, torch.eye(9, dtype=torch.float64), atol=2e-4, rtol=0)
    np.testing.assert_allclose(sh_basis(towards.numpy(), 2), y.numpy(), atol=1e-12)
    sh = 0.2 * np.random.default_rng(1).standard_normal((1, 9, 3)).astype(np.float32)
    one = Splats(
        np.zeros((1, 3), np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), 5, np.float32),
        np.ones(1, np.float32),
        sh,
    )
    eye = np.array([1.0, 2.0, -0.5])
    image = render(one, look_at(eye * 10, (0, 0, 0), width=9, height=9)).colors[0, 4, 4]
    away = torch.from_numpy(-eye / np.linalg.norm(eye))[None]
    np.testing.assert_allclose(image, seen(torch.from_numpy(sh), away)[0].clamp_min(0).numpy(), atol=0.01)


def test_projection_round_trips_and_pixels_lie_where_the_layout_says() -> None:
    coefficients = torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    towards, _ = equirectangular(128, 256, dtype=torch.float64)
    picture = sh_basis(towards, 2) @ coefficients
    torch.testing.assert_close(project_sh(picture), coefficients, atol=1e-3, rtol=1e-3)
    d = towards[20, 50].numpy()  # u = atan2(x, -z) / 2 pi, v = acos(y) / pi
    assert np.arctan2(d[0], -d[2]) / (2 * np.pi) % 1 == pytest.approx(50.5 / 256)
    assert np.arccos(d[1]) / np.pi == pytest.approx(20.5 / 128)


def test_irradiance_of_a_constant_environment_is_pi_times_it() -> None:
    light = torch.full((64, 128, 3), 0.7, dtype=torch.float64)
    e = irradiance(project_sh(light), directions(50))
    torch.testing.assert_close(e, torch.full_like(e, 0.7 * torch.pi), atol=1e-3, rtol=0)
    torch.testing.assert_close(project_sh(light) / 0.7, uniform_light().coefficients.double(), atol=2e-3, rtol=0)


def test_irradiance_of_a_lobe_is_the_cosine_integral() -> None:
    """A clamped linear lobe has no odd bands above 1, and the cosine kernel's next band is 1 / 64: 3 % at most."""
    towards, area = equirectangular(128, 256, dtype=torch.float64)
    axis = torch.tensor([0.36, 0.8, -0.48], dtype=torch.float64)
    picture = (towards @ axis).clamp_min(0)[..., None].expand(-1, -1, 3)
    normals = directions(40)
    cosine = torch.einsum("hwc,nc->nhw", towards, normals).clamp_min(0)
    truth = torch.einsum("nhw,hwc->nc", cosine * area, picture)
    torch.testing.assert_close(irradiance(project_sh(picture), normals), truth, atol=0.03 * float(truth.max()), rtol=0)


def test_mirroring_coefficients_mirrors_the_function() -> None:
    f = torch.randn(9, 3, dtype=torch.float64)
    normals, d = directions(30), directions(30, 1)
    bounced = d - 2 * (d * normals).sum(1, keepdim=True) * normals
    actual = torch.einsum("nkc,nk->nc", mirrored_sh(f, normals), sh_basis(d, 2))
    torch.testing.assert_close(actual, sh_basis(bounced, 2) @ f)
    many = torch.stack([f, 2 * f])
    torch.testing.assert_close(mirrored_sh(many, normals)[1], 2 * mirrored_sh(f, normals))


def test_uniform_light_shows_matt_albedo_through_the_tone_map() -> None:
    """The specular layer of a matt surface adds about 2 % of the light, whatever its normal."""
    sh = shade(surfels(directions(20), albedo=0.4, roughness=1.0, occlusion=1.0), uniform_light())
    color = 0.5 + SH_C0 * sh[:, 0]
    low, high = float(tone_map(np.array([0.4], np.float32))[0]), float(tone_map(np.array([0.43], np.float32))[0])
    assert (color > low).all() and (color < high).all()
    assert float(color.max() - color.min()) < 1e-5


def test_a_metal_shows_the_blurred_environment_at_the_mirrored_direction() -> None:
    light = make_light(torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(3)) + 0.5)
    normals = directions(30)
    metal = surfels(normals, albedo=0.9, metallic=1.0, roughness=0.3)
    sh = shade(metal, light, degree=2)
    alpha2 = 0.3**4
    band = torch.tensor([0, 1, 1, 1, 2, 2, 2, 2, 2.0])
    blurred = light.coefficients * torch.exp(-band * (band + 1) * alpha2)[:, None]
    x, y, z, w = 0.7, 0.0425 - 0.0275 * 0.3, 1.04 - 0.572 * 0.3, 0.022 * 0.3 - 0.04  # Karis' fit, cosine 0.7
    a = min(x * x, 2 ** (-9.28 * 0.7)) * x + y
    share = 0.9 * (-1.04 * a + z) + max(1.04 * a + w, 0)
    straight = tone_map(share * (sh_basis(normals.float(), 2) @ blurred), light.exposure)
    torch.testing.assert_close(seen(sh, -normals), straight, atol=1e-5, rtol=0)
    d = torch.nn.functional.normalize(-normals + 0.5 * directions(30, 7), dim=1)
    bounced = d - 2 * (d * normals).sum(1, keepdim=True) * normals
    truth = tone_map(share * (sh_basis(bounced.float(), 2) @ blurred), light.exposure)
    torch.testing.assert_close(seen(sh, d), truth, atol=0.02, rtol=0)  # the tone curve is linear around the normal


def test_shadows_darken_and_lights_can_be_batched() -> None:
    lights = [random_light(np.random.default_rng(k)) for k in range(3)]
    some = surfels(directions(12))
    for degree, count in ((0, 1), (1, 4), (2, 9)):
        alone = torch.stack([shade(some, light, degree) for light in lights])
        assert alone.shape == (3, 12, count, 3) and torch.isfinite(alone).all()
        together = shade_all(
            some, torch.stack([x.coefficients for x in lights]), torch.stack([x.exposure for x in lights]), degree
        )
        torch.testing.assert_close(together, alone)
    hidden = Surfels(**{**vars(some), "transfer": 0.2 * some.transfer, "occlusion": 0.2 * some.occlusion})
    assert (shade(hidden, lights[0])[:, 0] < shade(some, lights[0])[:, 0]).all()
    with pytest.raises(ValueError, match="degree"):
        shade(some, lights[0], 3)


def test_the_tone_map_is_srgb_below_the_shoulder_and_never_exceeds_one() -> None:
    x = torch.linspace(0, 50, 20001, dtype=torch.float64)
    y = tone_map(x)
    assert (y.diff() > 0).all() and float(y[-1]) < 1
    low = x[(x > 0.0032) & (x < 0.8)]
    torch.testing.assert_close(tone_map(low), 1.055 * low ** (1 / 2.4) - 0.055)
    assert float(tone_map(torch.tensor([0.002]))[0]) == pytest.approx(12.92 * 0.002)
    np.testing.assert_allclose(tone_map(np.array([0.1], np.float32), 2.0), tone_map(np.array([0.2], np.float32)))


def test_exposure_undoes_the_brightness_of_an_environment() -> None:
    picture = torch.rand(16, 32, 3)
    dark, bright = project_sh(picture), project_sh(100 * picture)
    assert float(auto_exposure(dark) / auto_exposure(bright)) == pytest.approx(100, rel=1e-4)
    assert float(make_light(picture, stops=1).exposure / make_light(picture).exposure) == pytest.approx(2)


def test_random_lights_repeat_from_the_generators_state() -> None:
    files = [torch.rand(16, 32, 3), torch.rand(16, 32, 3)]
    for given in ((), files):
        first, again = (random_light(np.random.default_rng(5), given) for _ in range(2))
        assert torch.equal(first.environment, again.environment) and torch.equal(first.exposure, again.exposure)
        other = random_light(np.random.default_rng(6), given)
        assert not torch.equal(first.coefficients, other.coefficients)
        assert torch.isfinite(first.environment).all() and (first.environment >= 0).all()


def rgbe(pixels: np.ndarray) -> bytes:
    """[h, w, 4] uint8 -> a plain .hdr file."""
    h, w = pixels.shape[:2]
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (h, w) + pixels.tobytes()


def test_plain_pixels_are_decoded_by_the_formula(tmp_path: Path) -> None:
    pixels = np.array([[[128, 64, 0, 129], [200, 100, 50, 136], [9, 9, 9, 0]]], np.uint8)
    (tmp_path / "sky.hdr").write_bytes(rgbe(pixels))
    np.testing.assert_allclose(load_environment(tmp_path / "sky.hdr")[0], [[1, 0.5, 0], [200, 100, 50], [0, 0, 0]])


def test_runs_are_decoded_by_the_formula_and_cut_files_refused(tmp_path: Path) -> None:
    planes = [bytes([128 + 10, 128]), bytes([4, 1, 2, 3, 4, 128 + 6, 7]), bytes([128 + 10, 0]), bytes([128 + 10, 136])]
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 10\n" + bytes([2, 2, 0, 10]) + b"".join(planes)
    (tmp_path / "sky.hdr").write_bytes(data)
    image = load_environment(tmp_path / "sky.hdr").numpy()
    np.testing.assert_allclose(image[0, :, 0], 128)
    np.testing.assert_allclose(image[0, :, 1], [1, 2, 3, 4, 7, 7, 7, 7, 7, 7])
    for cut in range(20, len(data)):
        (tmp_path / "sky.hdr").write_bytes(data[:cut])
        with pytest.raises(ValueError, match="sky.hdr"):
            load_environment(tmp_path / "sky.hdr")


def test_exr_environments_keep_their_light(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.random.default_rng(0).uniform(0, 50, (4, 8, 3)).astype(np.float16).astype(np.float32)
    (tmp_path / "sky.exr").write_bytes(encode_exr(picture))
    np.testing.assert_array_equal(load_environment(tmp_path / "sky.exr"), picture)
    (tmp_path / "grey.exr").write_bytes(encode_exr(picture[..., :1]))
    np.testing.assert_array_equal(load_environment(tmp_path / "grey.exr"), picture[..., :1].repeat(3, 2))
    monkeypatch.setattr(sky_maps, "MAX_PIXELS", 31)
    with pytest.raises(ValueError, match=r"grey.exr: expected 1 to 31 pixels, the header says 8 x 4"):
        load_environment(tmp_path / "grey.exr")


def test_hdr_agrees_with_mitsuba(tmp_path: Path) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    rng = np.random.default_rng(0)
    image = (rng.random((12, 40, 3)) * np.exp(rng.normal(0, 3, (12, 40, 1)))).astype(np.float32)
    image[:, 5:20] = image[:, 5:6]  # something to run-length code
    mi.Bitmap(image).write(str(tmp_path / "a.hdr"))
    expected = np.array(mi.Bitmap(str(tmp_path / "a.hdr")), np.float32)
    # Both decode a mantissa byte b as b, and not as b + 0.5.
    np.testing.assert_allclose(load_environment(tmp_path / "a.hdr").numpy(), expected[..., :3], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "data", "line"),
    [
        ("a.hdr", None, "no such file"),
        ("a.png", b"", "expected an environment"),
        ("a.hdr", b"GIF89a", "is not a Radiance"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n1234", "is not a Radiance"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n+Z 1 +X 1\n1234", "is not a Radiance"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999 +X 99999\n1234", "is not a Radiance"),
        ("a.hdr", rgbe(np.zeros((2, 2, 4), np.uint8)), "black"),
    ],
)
def test_bad_environments_give_one_line(tmp_path: Path, name: str, data: bytes | None, line: str) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=line) as caught:
        load_environment(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_a_few_bad_pixels_become_black_and_many_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.ones((20, 40, 3), np.float32)
    picture[0, 0], picture[1, 1] = np.nan, np.inf
    monkeypatch.setattr(sky_maps, "read_samples", lambda path, where: picture)
    assert torch.isfinite(load_environment(tmp_path / "x.hdr")).all()
    picture[:5] = -1
    with pytest.raises(ValueError, match="200 of 800 pixels are NaN"):
        load_environment(tmp_path / "x.hdr")
