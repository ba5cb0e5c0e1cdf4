"""Touch files: prior knowledge of a gel, its weights, and touch maps for each slice."""
