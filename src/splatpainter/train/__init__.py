"""Training: losses, optimiser, the three stages and the loop around them. A leaf: only the commands import it."""
