"""Colour grading: sliders, tables, the colours of another picture."""
