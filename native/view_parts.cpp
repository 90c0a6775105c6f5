// Parts of projected views, and two of them as one: splatpainter/rendering/cpu/projected_view.py.
#include "kernels.h"
#include "rendering/view_parts.h"

SP_KERNELS_TO_V3(view_parts,
    FLOAT_FIRST(mark_tiles),
    ONE(count_pairs),
    ONE(number_entries),
    ONE(take_pairs),
    ONE(list_chosen_pairs),
    FLOAT_FIRST(put_entries),
    FLOAT_FIRST(merge_entries),
    ONE(merge_pairs)
)
