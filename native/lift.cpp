#include "kernels.h"
#include "lift/box_mean.h"
#include "lift/detail.h"
#include "lift/joint_colors.h"
#include "lift/merging.h"
#include "lift/near_surface.h"
#include "lift/nearest_pixels.h"
#include "lift/picture_change.h"
#include "lift/sheet.h"
#include "lift/visible_depth.h"

SP_KERNELS(lift,
    ONE(mean_over_boxes),
    BOTH(compare_pictures),
    BOTH(measure_contrast),
    ONE(find_nearest_pixels),
    FLOAT_FIRST(classify_sides),
    ONE(choose_cells),
    ONE(lay_gaussians),
    ONE(mark_past_horizon),
    ONE(find_partners),
    FLOAT_FIRST(find_stopping_depths),
    ONE(take_depth_medians),
    ONE(take_depth_means),
    ONE(measure_reaches),
    ONE(choose_details),
    ONE(change_colors),
    ONE(add_residual),
    ONE(add_squares)
)
