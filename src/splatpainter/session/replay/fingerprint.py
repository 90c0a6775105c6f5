"""What of a painter decides the results of layers, as text: it stands in their keys."""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from splatpainter.lift.local import correction
from splatpainter.nn.precision import resolve
from splatpainter.painter import Method, Mode, Painter

if TYPE_CHECKING:
    from splatpainter.models.local_network import LocalNetwork
    from splatpainter.models.model import SplatPainterModel

LIFT = "lift-2"
"""Which lift it is: another number with every change that gives other Gaussians. Results that are stored stay as they
are; where one has to be computed anew it is lifted as now, and the layer's note says so."""


def fingerprint(painter: Painter, method: Method, mode: Mode) -> str:
    """What of a painter decides the results of a method in a mode, as text: its settings, the hash of the weights that
    it uses there, and bf16 where its networks are rounded to that. method: not "auto"."""
    settings = f"{painter.settings.local_options!r} {painter.settings.global_options!r} {LIFT}"
    if method == "corrected":
        return f"{method} {settings} {correction.digest()}"
    if method != "ttt":
        return f"{method} {settings}"
    # The network that reads pictures has no polish and is never rounded.
    if painter.reads_pictures(mode):
        assert painter.local is not None
        return f"ttt {settings} local {_digest(painter.local)}"
    if painter.model is None:
        return f"{method} {settings}"
    device = next(painter.model.parameters()).device
    rounded = " bfloat16" if resolve(painter.settings.precision, device) == "bfloat16" else ""
    return f"ttt {settings} polish={painter.settings.polish} {_digest(painter.model)}{rounded}"


def _digest(network: SplatPainterModel | LocalNetwork) -> str:
    if network not in _DIGESTS:
        from splatpainter.models.cache import digest

        _DIGESTS[network] = digest(network)
    return _DIGESTS[network]


_DIGESTS: WeakKeyDictionary[SplatPainterModel | LocalNetwork, str] = WeakKeyDictionary()
"""Digests of the networks in use, whose weights do not change meanwhile; hashing one takes longer than a small edit."""
