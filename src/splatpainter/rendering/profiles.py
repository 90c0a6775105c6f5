"""Whose formula turns a Gaussian's exponent into alpha: with s >= 0 half the squared distance in standard deviations,
o the opacity and T a pixel's transmittance before the row,

    "inria"        alpha = min(0.999, o e^-s)               taken while T (1 - alpha) > 1e-4
    "playcanvas"   alpha = min(0.99, o (e^-s - e^-4.5))     taken while T >= 1e-4

both where alpha >= 1/255. "inria" is Kerbl et al. 2023 in gsplat's conventions, for which nearly all assets are
trained. "playcanvas" is the picture renderer of PlayCanvas's splat-transform (3.x; its constants: src/lib/render/
config.ts), which lets a Gaussian end at 0 at three standard deviations: the same file is about 1 % darker there. What
that renderer does besides is left out: near plane at 0.2, no compensation of antialiased assets, fading of rows larger
than the picture. PlayCanvas's live viewer and SuperSplat's differ from both: o (e^-s - e^-4) / (1 - e^-4), no cap, and
a blur of 0.075 px^2 where all others have 0.3.
"""

from __future__ import annotations

import math
from typing import Literal

Profile = Literal["inria", "playcanvas"]
PROFILES = ("inria", "playcanvas")
PLAYCANVAS_FLOOR = math.exp(-4.5)
"""What is taken from e^-s."""
PLAYCANVAS_CAP = 0.99
"""Largest alpha of one row."""
