"""Data for training and evaluation: objects, surfels, lights, edits, samples, shards. A leaf: only train/, evaluate/
and the command line stand on it."""
