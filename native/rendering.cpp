// Projection, tiles, compositing and their derivatives: splatpainter/rendering/cpu.
#include "kernels.h"
#include "rendering/backproject.h"
#include "rendering/backward.h"
#include "rendering/color_rounds.h"
#include "rendering/projection.h"
#include "rendering/projection_backward.h"
#include "rendering/rasterize.h"
#include "rendering/sirt.h"
#include "rendering/tile_binning.h"

SP_KERNELS(rendering,
    FLOAT_FIRST(select_near_window),
    FLOAT_FIRST(project_gaussians),
    FLOAT_FIRST(shade_entries),
    FLOAT_FIRST(project_gaussians_backward),
    ONE(sort_depths),
    FLOAT_FIRST(list_pairs),
    ONE(place_pairs),
    FLOAT_FIRST(rasterize_tiles),
    FLOAT_FIRST(heaviest_tiles),
    FLOAT_FIRST(rasterize_backward_tiles),
    FLOAT_FIRST(backproject_tiles),
    FLOAT_FIRST(mask_sums_tiles),
    FLOAT_FIRST(sirt_tiles),
    FLOAT_FIRST(add_gains),
    ONE(set_changed_colors),
    ONE(step_changes),
    FLOAT_FIRST(reduce_pairs),
    FLOAT_FIRST(reduce_mask_sums),
    FLOAT_FIRST(find_block_boxes),
    FLOAT_FIRST(cache_tiles),
    FLOAT_FIRST(cached_step_tiles)
)
