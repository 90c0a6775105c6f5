"""Feed-forward densification in the manner of GenDen (Nam et al., arXiv 2412.06234; no code of it was used), a
baseline: Gaussians that the input views pull at are replaced by finer ones, in one pass.

    densify_config.py  sizes and switches, presets `paper` and `compact`
    view_features.py   what the input views say about the Gaussians: which to choose, and their features
    densifier.py       the network with its weights; asset and views in, finer asset out
    training.py        the stage `splatpainter train densify`; recipes/ beside it

docs/GENDEN.md says where it differs from the published system.
"""
