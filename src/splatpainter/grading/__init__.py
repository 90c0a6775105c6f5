"""Looks on an asset or on a region of it: sliders, LUTs, the colours of a reference picture, one new colour."""
