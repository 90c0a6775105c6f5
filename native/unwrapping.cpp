// Surfaces laid flat, for holes and sheets of textures: splatpainter/surface/unwrap.py.
#include "kernels.h"
#include "surface/unwrap.h"

SP_KERNELS_TO_V3(unwrapping,
    ONE(thin_points),
    ONE(smooth_points),
    ONE(spread_map),
    ONE(interpolate_map)
)
