"""The asset in a cube of voxels: which Gaussians share one, what a ray meets first."""
