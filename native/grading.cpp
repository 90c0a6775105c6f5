#include "kernels.h"
#include "grading/slopes.h"
#include "maths.h"

namespace sp { namespace {

// A power curve on each side of a pivot, of display colours within 0 to 1: `adjust_contrast` of grading/
// color_grading.py.
void bend_levels(Array1<const float> levels, double slope, double pivot, Array1<float> out, i64 thread, i64 threads) {
    const float low = (float)pivot, high = (float)(1 - pivot);
    const Share share = share_of(levels.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const float value = min_of(max_of(levels(i), 0.0f), 1.0f);
        const bool dark = value < low;
        const double part = dark ? value / low : (1 - value) / high;
        const float bent = (float)exp_of(slope * log_of(part));
        out(i) = dark ? low * bent : 1 - high * bent;
    }
}

} }  // namespace sp

SP_KERNELS_TO_V3(grading,
    ONE(bend_levels),
    ONE(take_base_colors),
    ONE(grade_bands)
)
