"""The three stages as tasks: modules that own the model and turn a sample into a loss."""
