"""Feed-forward densification in the manner of GenDen (Nam et al., arXiv 2412.06234; no code of it was used): rows that
the input views pull at are replaced by finer ones, in one pass.

    config.py     sizes and switches, presets `paper` and `compact`
    curves.py     points in the order of space-filling curves
    looks.py      what the input views say about the rows: which to choose, and their features
    network.py    two levels of attention along the curves, masks and children
    densifier.py  the whole: asset and views in, finer asset out; weights on disk

Where it differs from the published system: features come from the rows and from the pictures at the rows' places
(there: from the volumes of a LaRa reconstructor, which is not here); a child's cell is its parent's ellipsoid (there: a
cell of the volume); and in `compact` new rows start as even splits of their parents, so that an untrained network
changes a picture little.
"""
