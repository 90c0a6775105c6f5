"""Pictures laid on the surface: where, how they bend, what each view shows of them."""
