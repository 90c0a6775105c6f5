"""The constants of 3DGS rendering, and whose formula turns a Gaussian's exponent into alpha.

With s >= 0 half the squared distance in standard deviations, o the opacity and T a pixel's transmittance before the
Gaussian,

    "inria"        alpha = min(0.999, o e^-s)               accepted while T (1 - alpha) > 1e-4
    "playcanvas"   alpha = min(0.99, o (e^-s - e^-4.5))     accepted while T >= 1e-4

both where alpha >= 1/255. "inria" is Kerbl et al. 2023 in gsplat's conventions, for which nearly all assets are
trained. "playcanvas" is the picture renderer of PlayCanvas's splat-transform (3.x; its constants: src/lib/render/
config.ts), which lets a Gaussian end at 0 at three standard deviations: the same file is about 1 % darker there. What
that renderer does besides is left out: near plane at 0.2, no compensation of antialiased assets, fading of Gaussians
larger than the picture. PlayCanvas's live viewer and SuperSplat's differ from both: o (e^-s - e^-4) / (1 - e^-4), no
cap, and a blur of 0.075 px^2 where all others have 0.3.
"""

from __future__ import annotations

import math
from typing import Literal

Profile = Literal["inria", "playcanvas"]
PROFILES = ("inria", "playcanvas")

MIN_ALPHA = 1 / 255
"""Alphas below this are not drawn."""
MAX_ALPHA = 0.999
"""Largest alpha of one Gaussian (gsplat 1.5.3)."""
MIN_TRANSMITTANCE = 1e-4
"""A pixel accepts no Gaussian that would bring its transmittance to this or below."""
PLAYCANVAS_MAX_ALPHA = 0.99
PLAYCANVAS_FALLOFF = math.exp(-4.5)
"""What is taken from e^-s."""

NEAR_PLANE = 0.01
"""Gaussians with z below this are not drawn, world units."""
EPS2D = 0.3
"""Added to the diagonal of every 2D covariance, px^2: the width of a pixel's own filter."""
JACOBIAN_MARGIN = 0.15
"""Jacobians are taken at most this fraction of the picture outside it."""
MAX_DISTANCE_PX = 1e9
"""Gaussians whose centre is projected farther than this from the picture's corner, in pixels, are not drawn: beyond
about 1e19 the squares of distances to pixels would not fit into float32."""
