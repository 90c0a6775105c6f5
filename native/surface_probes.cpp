// Inner functions of surface/ by themselves, for tests.
#include "kernels.h"
#include "surface/estimate.h"

namespace sp { namespace {

// What one search finds: found[0] samples, in `out`, which has room for one more; as many as it is long where they do
// not fit.
void probe_gather(Array1<const i64> keys, Array1<const i64> level_starts, Array1<const double> cell_sizes,
                  Array1<const double> reaches, Array1<const double> corner,
                  Rows<const float, surface::PATCH_COLUMNS> patches, Array1<const double> point, double window,
                  Array1<i64> out, Array1<i64> found, i64 thread, i64) {
    if (thread != 0) return;
    const surface::Grid grid = {keys, level_starts, cell_sizes, reaches, corner, patches};
    found(0) = surface::gather(grid, point.data, window, out.data, out.shape[0] - 1);
}

} }  // namespace sp

SP_KERNELS(surface_probes,
    ONE(probe_gather)
)
