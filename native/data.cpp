#include "kernels.h"
#include "data/mesh_visibility.h"
#include "data/poisson_disk.h"
#include "data/textures.h"

SP_KERNELS_TO_BASE(data,
    ONE(fill_point_grid),
    ONE(throw_points),
    ONE(take_mean_distances),
    ONE(find_closest_centers),
    ONE(count_tile_members),
    ONE(list_tile_members),
    ONE(hide_points),
    ONE(sample_bilinear)
)
