// Inner functions by themselves, for tests.
#include "kernels.h"
#include "rendering/compositing.h"
#include "rendering/projection.h"

namespace sp { namespace {

// out [n, 5]: clamped(m, last), tile_span(m, e, first, last), blocks_hit(m, e).
template <class F>
void probe_spans(Array1<const F> m, Array1<const F> e, i64 first, i64 last, Rows<i64, 5> out, i64 thread, i64) {
    if (thread != 0) return;
    for (i64 i = 0; i < m.shape[0]; ++i) {
        const Span tiles = tile_span(m(i), e(i), first, last);
        const Blocks blocks = blocks_hit(m(i), e(i));
        out(i, 0) = clamped(m(i), last);
        out(i, 1) = tiles.begin, out(i, 2) = tiles.end;
        out(i, 3) = blocks.begin, out(i, 4) = blocks.end;
    }
}

// The constants of rendering, as splatpainter/rendering/profiles.py, splats.py and rendering/cpu/geometry.py have them.
void probe_constants(Array1<double> out, i64, i64) {
    const double constants[] = {MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, PLAYCANVAS_MAX_ALPHA, PLAYCANVAS_FALLOFF,
                                NEAR_PLANE, EPS2D, MAX_DISTANCE_PX, MAX_MAGNITUDE, MIN_QUAT, TILE, COLUMNS,
                                CAMERA_SIZE, GAUSSIANS_PER_BLOCK};
    for (i64 i = 0; i < (i64)(sizeof constants / sizeof *constants); ++i) out(i) = constants[i];
}

} }  // namespace sp

SP_KERNELS(probes,
    BOTH(probe_spans),
    ONE(probe_constants)
)
