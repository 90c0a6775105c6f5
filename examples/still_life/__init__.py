"""The still life of `splatpainter demo`, modelled and lit in numpy; `python -m examples.still_life` makes its file."""
