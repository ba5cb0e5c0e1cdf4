"""evaluate labels: labelled onsets against the true ones."""
