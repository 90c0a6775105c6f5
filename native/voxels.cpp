#include "kernels.h"
#include "voxels/footprints.h"
#include "voxels/neighbours.h"
#include "voxels/rays.h"

SP_KERNELS(voxels,
    ONE(pack_marked),
    ONE(pack_dense),
    ONE(measure_clearances),
    ONE(find_first_voxels),
    ONE(mark_seen_voxels),
    ONE(deposit_thickness),
    ONE(sum_thickness),
    ONE(find_touching),
    ONE(find_nearest),
    ONE(join_labels),
    ONE(flatten_labels)
)
