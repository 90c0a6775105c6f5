"""Holes in an asset filled with new Gaussians on a surface that continues what surrounds them. Pure."""
