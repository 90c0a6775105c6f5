"""Training of SplatPainter's networks: ground truth, edit samples, shards, stages. `splatpainter data`, `train`."""
