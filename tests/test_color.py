"""Colour formulas: the published curve by its constants, inverses, and torch as numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatpainter.color import base_color, from_hex, linear_to_srgb, luminance, sh_from_color, srgb_to_linear

SHADES = np.concatenate([np.linspace(0, 1, 4001), [0.04045, 0.0031308, 1.7]])


def test_the_curve_is_the_standards() -> None:
    # IEC 61966-2-1: a line up to 0.04045 (0.0031308 linear), a power of 2.4 beyond.
    assert srgb_to_linear(np.array(0.02)) == 0.02 / 12.92
    assert srgb_to_linear(np.array(0.5)) == pytest.approx(0.21404114, abs=1e-8)
    assert linear_to_srgb(np.array(0.18)) == pytest.approx(0.46135613, abs=1e-8)
    assert linear_to_srgb(np.array([0.0, 1.0])) == pytest.approx([0, 1], abs=1e-15)
    assert srgb_to_linear(np.array([2.0, np.inf])).tolist() == [pytest.approx(((2 + 0.055) / 1.055) ** 2.4), np.inf]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_curve_is_undone_by_its_inverse(dtype: type) -> None:
    shades = SHADES.astype(dtype)
    tolerance = 1e-6 if dtype == np.float32 else 2e-7  # the standard's two pieces meet to 2e-8 in linear light
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(shades)), shades, atol=tolerance)
    assert srgb_to_linear(shades).dtype == linear_to_srgb(shades).dtype == dtype
    assert (np.diff(srgb_to_linear(shades[:4001])) > 0).all() and (np.diff(linear_to_srgb(shades[:4001])) > 0).all()


def test_torch_gives_what_numpy_gives_and_has_slopes_everywhere() -> None:
    tensor = torch.from_numpy(SHADES)
    for function in (srgb_to_linear, linear_to_srgb):
        np.testing.assert_allclose(function(tensor).numpy(), function(SHADES), rtol=1e-14)
        shades = tensor.clone().requires_grad_()
        function(shades).sum().backward()
        assert shades.grad is not None and (shades.grad > 0).all() and shades.grad.isfinite().all()


def test_luminance_weighs_green_most_and_keeps_grey() -> None:
    assert luminance(np.array([[0.3, 0.3, 0.3], [1, 0, 0], [0, 1, 0], [0, 0, 1]])) == pytest.approx(
        [0.3, 0.2126, 0.7152, 0.0722]
    )


def test_base_colours_are_those_of_a_constant_function() -> None:
    colors = np.random.default_rng(0).uniform(-0.2, 1.2, (20, 3)).astype(np.float32)
    sh = np.ones((20, 4, 3), np.float32)
    sh[:, 0] = sh_from_color(colors)
    assert sh[:, 0].dtype == base_color(sh).dtype == np.float32
    np.testing.assert_allclose(base_color(sh), colors, atol=1e-6)
    np.testing.assert_allclose(base_color(torch.from_numpy(sh)).numpy(), base_color(sh))
    assert base_color(np.zeros((1, 3)))[0] == 0.5


def test_colours_are_six_hex_digits_with_or_without_a_sign() -> None:
    assert from_hex("#3380fF") == from_hex("3380ff") == (0.2, 128 / 255, 1.0)
    for text in ("", "#", "#12345", "#1234567", "##123456", "#+f+f+f", "#12 456", "12345g"):
        assert from_hex(text) is None
