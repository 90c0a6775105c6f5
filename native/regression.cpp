#include "kernels.h"
#include "lift/regression.h"

// Wider vectors do not quicken these: filling the features takes AVX-512 twice as long.
SP_KERNELS_TO_V3(regression,
    ONE(fill_regression_features),
    ONE(turn_bands),
    ONE(measure_leverage)
)
