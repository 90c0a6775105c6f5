#include "kernels.h"
#include "surface/curvature.h"
#include "surface/estimate.h"
#include "surface/lattice.h"
#include "surface/patches.h"
#include "surface/visible.h"

SP_KERNELS(surface,
    ONE(fill_patches),
    ONE(estimate_surface),
    FLOAT_FIRST(find_front_entries),
    ONE(choose_lattice_pixels),
    FLOAT_FIRST(measure_depths_along),
    ONE(count_agreeing),
    ONE(interpolate_planes),
    ONE(sum_turns)
)
