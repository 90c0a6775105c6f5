#include "kernels.h"
#include "lighting.h"

SP_KERNELS(lighting,
    ONE(draw_shadow_maps),
    ONE(fold_shadows),
    ONE(measure_neighbour_squares)
)
