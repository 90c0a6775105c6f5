"""Options of operations as several commands of the page have them (message.py)."""

from __future__ import annotations

from typing import Any, Literal

from splatpainter.operations.light import Delight, Relight
from splatpainter.operations.pixelate import Pixelate
from splatpainter.server.message import layer_options, options_message
from splatpainter.session.kinds.painted_layers import PaintedLayer

PaintedOptions = options_message(
    "PaintedOptions", PaintedLayer, ("mode", "method", "within"), "How pictures are painted."
)


class PaintLimits(options_message("LimitOptions", PaintedLayer, ("angle_limit", "depth_edge_limit"), "")):
    """What one view may paint of surfaces that it cannot see well; null: as the painter has it."""

    def options(self) -> dict[str, Any]:
        """The limits as options of a layer."""
        return self.model_dump(exclude_none=True)


class LightOptions(options_message("LightFields", Relight, layer_options(Relight), "")):
    """A new light on the asset, as a layer."""

    kind: Literal["light"]


class DelightOptions(options_message("DelightFields", Delight, layer_options(Delight), "")):
    """The light that is in the asset's colours taken out, as a layer."""

    kind: Literal["delight"]


class PixelateOptions(options_message("PixelateFields", Pixelate, layer_options(Pixelate), "")):
    """What is selected made unreadable from all sides, as a layer."""

    kind: Literal["pixelate"]


OperationOptions = LightOptions | DelightOptions | PixelateOptions
"""Operations that can be layers."""
