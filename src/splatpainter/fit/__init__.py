"""3D Gaussian Splatting as an optimiser (Kerbl et al. 2023): rows that make renders match pictures.

    parameters.py   rows as the optimiser holds them: log-scales, logit-opacities
    start.py        first rows: from coloured points, or from depth maps (neighbours.py: how far apart they are)
    spread.py       cameras evenly around an object
    loss.py         L1 and D-SSIM of two pictures, and their gradient
    adam.py         Adam over rows that come and go
    gradients.py    one view: its loss, the rows' gradients, and how each row's centre pulls on the screen
    densify.py      adaptive density control: clone, split, prune, reset
    optimize.py     the loop

Knows no files, no meshes and no edits: where the pictures come from is the caller's business.
"""
