"""What all numba kernels share: threads, SIMD vectors, compilation before the first use."""
