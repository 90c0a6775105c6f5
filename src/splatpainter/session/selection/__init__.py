"""Which Gaussians are chosen: weights, by masks, colours, attributes and places."""
