"""How much a picture may differ from its view, as options say it; the gatekeeper has the numbers."""

from __future__ import annotations

from typing import Literal

Strictness = Literal["strict", "normal", "loose"]
"""How much a picture may differ from what was sent; gatekeeper.LIMITS has the numbers."""
