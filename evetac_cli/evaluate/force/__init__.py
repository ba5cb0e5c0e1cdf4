"""evaluate force: estimated forces against the true ones."""
