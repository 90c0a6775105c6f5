"""3D Gaussian Splatting as an optimiser (Kerbl et al. 2023): Gaussians whose renders match pictures.

    parameters.py   Gaussians as the optimiser holds them: log-scales, logit-opacities; Adam that lets them come and go
    start.py        the first ones: from coloured points, or from depth maps
    image_loss.py   L1 and D-SSIM of two pictures, and their gradient
    gradients.py    one view: its loss, all gradients, and how each centre pulls on the screen
    densify.py      adaptive density control: clone, split, prune, reset
    optimize.py     the loop; edited.py: the loop on edited pictures

Knows no files, no meshes and no edits: where the pictures come from is the caller's business.
"""
