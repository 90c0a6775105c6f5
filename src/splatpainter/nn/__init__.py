"""Building blocks of the networks: packed attention, SwiGLU layers, fast weights. Know no splats and no cameras."""
