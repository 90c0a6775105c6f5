#include "kernels.h"
#include "spread/fourier.h"
#include "spread/point_neighbours.h"

SP_KERNELS_TO_V3(spread,
    ONE(find_neighbours),
    ONE(take_neighbour_means),
    ONE(smooth_once),
    ONE(take_fourier_features),
    ONE(predict_from_features)
)
