"""Paint on the surface: new Gaussians on it, in place of those that they cover."""
