"""The native kernels of native/: the library that they lie in, threads, arrays."""
