#include "kernels.h"
#include "grading/slopes.h"

SP_KERNELS_TO_V3(grading,
    ONE(take_base_colors),
    ONE(grade_bands)
)
