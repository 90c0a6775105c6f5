// Projection, tiles, compositing and their derivatives: splatpainter/rendering/cpu.
#include "kernels.h"
#include "rendering/backproject.h"
#include "rendering/backward.h"
#include "rendering/projection.h"
#include "rendering/projection_backward.h"
#include "rendering/rasterize.h"
#include "rendering/sirt.h"
#include "rendering/tile_binning.h"

SP_KERNELS(rendering,
    BOTH(select_near_window),
    BOTH(project_gaussians),
    BOTH(project_gaussians_backward),
    ONE(sort_depths),
    BOTH(gather_sorted),
    BOTH(list_pairs),
    ONE(place_pairs),
    BOTH(mark_tiles),
    ONE(count_pairs),
    ONE(take_pairs),
    BOTH(put_entries),
    BOTH(merge_entries),
    ONE(merge_pairs),
    BOTH(rasterize_tiles),
    BOTH(heaviest_tiles),
    BOTH(rasterize_backward_tiles),
    BOTH(backproject_tiles),
    BOTH(mask_sums_tiles),
    BOTH(sirt_tiles),
    BOTH(reduce_pairs),
    BOTH(reduce_mask_sums),
    BOTH(cache_tiles),
    BOTH(cached_step_tiles)
)
