"""Spread: what one view says of a material, applied to the rest of it. Descriptors of Gaussians, a classifier that is
solved exactly for every edit, and the change of colour.
"""
