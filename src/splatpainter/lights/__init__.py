"""New light on a finished asset, baked into its colours: environments, suns and lamps, the light that was baked in,
and the transfer from one to the other by the ratio of what reaches each Gaussian."""
