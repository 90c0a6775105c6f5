"""Data for training and evaluation: objects, surfels, lights, edits, samples, shards. A leaf: only train/, the
benchmarks and the command line use it."""
