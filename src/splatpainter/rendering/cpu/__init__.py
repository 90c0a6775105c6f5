"""Kernels on the CPU: projection, tiles, compositing and their derivatives, in numpy arrays. Knows no torch."""
