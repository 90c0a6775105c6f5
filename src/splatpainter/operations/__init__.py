"""What can be done to an asset, each as one value that command line, batch, layers, nodes and Python share. Begin with
operation.py."""
