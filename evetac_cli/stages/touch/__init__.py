"""Touch files: what is known of a gel, its weights, and touch maps slice by slice."""
