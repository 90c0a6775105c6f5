"""Moving pictures of an asset: turntables as MP4 (AV1) and animated WebP. `turntable` says what is seen, `mp4` knows
the container."""
