"""Compile (or load) the kernels of this package."""

from __future__ import annotations

from splatpainter.spread import classifier, nearest_neighbours


def warm() -> None:
    """A classifier of eight points, and the neighbours of forty."""
    classifier.warm()
    nearest_neighbours.warm()
