// What the shared library exports: the kernels of all subjects, the tables of the best kind for this CPU first.
#include "kernels.h"
#ifdef SP_X86
#include <cpuid.h>
#endif

#if defined(_WIN32)
#define SP_EXPORT extern "C" __declspec(dllexport)
#else
#define SP_EXPORT extern "C" __attribute__((visibility("default")))
#endif

// SP_SUBJECTS(X) is X(rendering) X(surface) ..., of the files beside this one; SP_SOURCES the hash of all of them.
#define SP_DECLARE(target, subject) extern const Kernel kernels_##subject##_##target[];
#define SP_TABLE(target, subject) kernels_##subject##_##target,
namespace sp {

#define SP_EACH(subject) SP_DECLARE(base, subject)
SP_SUBJECTS(SP_EACH)
#undef SP_EACH
#define SP_EACH(subject) SP_TABLE(base, subject)
static const Kernel* const tables_base[] = {SP_SUBJECTS(SP_EACH) nullptr};
#undef SP_EACH
#ifdef SP_X86
#define SP_EACH(subject) SP_DECLARE(v3, subject) SP_DECLARE(v4, subject)
SP_SUBJECTS(SP_EACH)
#undef SP_EACH
#define SP_EACH(subject) SP_TABLE(v3, subject)
static const Kernel* const tables_v3[] = {SP_SUBJECTS(SP_EACH) nullptr};
#undef SP_EACH
#define SP_EACH(subject) SP_TABLE(v4, subject)
static const Kernel* const tables_v4[] = {SP_SUBJECTS(SP_EACH) nullptr};
#undef SP_EACH
#endif

struct Target {
    const char* name;
    const Kernel* const* tables;
};

#ifdef SP_X86
static u64 enabled_state() {
    unsigned low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return ((u64)high << 32) | low;
}
// Levels of the x86-64 psABI: 3 is AVX2 with FMA, BMI, F16C, LZCNT, MOVBE; 4 adds AVX-512 F, BW, CD, DQ, VL; the system
// must save the registers.
static int level() {
    unsigned a, b, c, d;
    if (!__get_cpuid(1, &a, &b, &c, &d)) return 2;
    const unsigned osxsave = 1u << 27, need1 = (1u << 12) | (1u << 22) | (1u << 28) | (1u << 29);
    if (!(c & osxsave) || (c & need1) != need1 || (enabled_state() & 6) != 6) return 2;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return 2;
    const unsigned need3 = (1u << 3) | (1u << 5) | (1u << 8);
    if ((b & need3) != need3) return 2;
    unsigned e, f, extended, g;
    if (!__get_cpuid(0x80000001u, &e, &f, &extended, &g) || !(extended & (1u << 5))) return 2;  // LZCNT
    const unsigned need4 = (1u << 16) | (1u << 17) | (1u << 28) | (1u << 30) | (1u << 31);
    return (b & need4) == need4 && (enabled_state() & 0xe6) == 0xe6 ? 4 : 3;
}
#endif

// Tables that this CPU can run, the best first, ended by a null name. `out` has room for 4.
SP_EXPORT void splatpainter_targets(Target* out) {
    int n = 0;
#ifdef SP_X86
    const int highest = level();
    if (highest >= 4) out[n++] = {"v4", tables_v4};
    if (highest >= 3) out[n++] = {"v3", tables_v3};
#endif
    out[n++] = {"base", tables_base};
    out[n] = {nullptr, nullptr};
}

// Hash of the sources that this was compiled from (splatpainter/kernels/library.py compares it in checkouts).
SP_EXPORT const char* splatpainter_sources() { return SP_SOURCES; }

}  // namespace sp
