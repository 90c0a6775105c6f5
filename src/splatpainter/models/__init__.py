"""The model of the paper (arXiv 2512.05354): Gaussian LRM, Stage I, Stage II, decoder, presets, checkpoints."""
