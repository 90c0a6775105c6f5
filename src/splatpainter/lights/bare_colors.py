"""The white light that shows the colours of an asset's materials once the light that is baked in is divided out.

A colour over its irradiance is an albedo times an error, as light, normals and shadows are only estimated. Where too
little light is divided out, colours come out that no material has: none gives back more than it gets. If albedos are
taken for uniform in 0..1 beforehand, and the error's natural logarithm for normal with standard deviation s, the mean
of what the albedo may be is nearly

    x / (1 + x^p)^(1 / p),   x = e^(3/2 s^2) colour / irradiance,   p = 0.866 / s

(within 0.04 for s up to 0.5 and x up to 2, within 0.001 at x = 1). It is hardly less than x where x is small, and
where nothing is doubted it is the lesser of x and 1.
"""

from __future__ import annotations

import numpy as np

from splatpainter.color import luminance
from splatpainter.kernels import portable
from splatpainter.lighting import unoccluded_transfer
from splatpainter.order_statistics import quantile
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere


@dataclass(frozen=True)
class BareColors:
    """How light is taken out."""

    lit_share: float = 0.9
    """Of all directions, those that get less than the lit side. Colours there are as bright as before: photographs are
    exposed for it, and a white surface there is nearly white in them."""
    directions: int = 128
    """Of normals, at which irradiance is asked for."""
    change_error: float = 0.15
    """Standard deviation of the logarithm of irradiance that is divided out, over its size: normals and shadows.
    20 path traced tuning meshes, true lights, scale-invariant dB of albedo over the asset as it is, for 0, 0.15, 0.3
    and 0.45: fitted 3.7, 3.9, 3.8 and 3.5, clean 7.1, 7.4, 7.1 and 6.4."""
    least_error: float = 1e-3
    """Of it, so that exponents are finite."""
    half: float = 0.866
    """ln 2 / 0.8: the exponent over 1 / s with which both means are alike at x = 1."""


BARE = BareColors()


def lit_side(coefficients: np.ndarray) -> float:
    """Luminance of the irradiance (that of radiance 1 from all around is 1) of the lit side of what stands free in an
    environment with SH [9, 3]."""
    normals = fibonacci_sphere(BARE.directions)
    received = portable.matmul(unoccluded_transfer(normals).astype(np.float64) / np.pi, luminance(coefficients))
    return float(quantile(np.maximum(received, 0), BARE.lit_share))


def white_light(
    colors: np.ndarray, received: np.ndarray, uncertainty: float, brightness: float, floor: float
) -> np.ndarray:
    """[N, 3] white irradiance that takes the place of `received` [N, 3], that of the light before, on Gaussians of
    linear colours [N, 3]. uncertainty: of that light, as of `SourceLight`; brightness: `lit_side` of it; floor: what is
    added to irradiances before one is divided by the other."""
    level = max(brightness, floor) + floor
    change = portable.log(level / (luminance(received) + floor))
    error = np.sqrt(uncertainty**2 + (BARE.change_error * change) ** 2)
    exponent = BARE.half / np.maximum(error, BARE.least_error)
    # The light's error is everyone's, and so is what it does to the mean.
    level = level * float(portable.exp(1.5 * uncertainty**2))
    # By the brightest channel, so that hues stay. What was whiter than white before, as lamps are, may stay so.
    divided = (np.maximum(colors, 0) * level / (received + floor)).max(1) / np.maximum(colors.max(1), 1)
    steep = exponent * portable.log(np.maximum(divided, 1e-12))
    above = np.maximum(steep, 0) + portable.log1p(portable.exp(-np.abs(steep)))  # ln(1 + e^steep), without overflow
    rolled_off = level * portable.exp(-above / exponent) - floor
    return np.repeat(np.maximum(rolled_off, 0)[:, None], 3, 1)
