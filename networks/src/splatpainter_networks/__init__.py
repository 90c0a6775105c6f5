"""Weights of SplatPainter's networks: one folder per preset, found by splatpainter.models.checkpoint."""
