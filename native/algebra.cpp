#include "kernels.h"
#include "algebra/activations.h"
#include "algebra/normal_equations.h"
#include "algebra/products.h"

SP_KERNELS(algebra,
    BOTH(multiply_matrices),
    ONE(multiply_by_doubles),
    BOTH(add_transposed_product),
    BOTH(add_normal_equations),
    ONE(solve_symmetric),
    ONE(silu_each)
)
