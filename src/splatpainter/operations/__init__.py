"""What can be done to an asset, each as one value."""
