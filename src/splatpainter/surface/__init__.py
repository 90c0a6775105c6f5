"""The surface that an asset's Gaussians are samples of: where it is, which way it faces, and how far to trust that."""
