"""The analytic lift: edited pictures written onto the Gaussians that make them, with no weights at all.

edits        one or several views, local or global: where to start reading
local_edit   one view: which Gaussians it reaches, patch (split, colour), put back
global_edit  views that change everything: colours of several views, then a regression for what no view shows
masks        which pixels were edited; surface: where the pixels lie; evidence: what a view says of each Gaussian
"""
