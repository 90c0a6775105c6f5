"""numba kernels: projection, tiles, compositing and their derivatives, in numpy arrays. Knows no torch."""

from splatpainter.kernels.compile import drop_stale

# Before any kernel of this package is loaded from numba's cache.
drop_stale()
