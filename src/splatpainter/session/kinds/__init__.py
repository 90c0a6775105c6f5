"""What kinds of layers there are: each one frozen dataclass, its options and what it does (layer_operation.py)."""
