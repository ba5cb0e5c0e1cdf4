"""Forces from displacements of the dots: two models of shear force with training, and forces from touch maps."""
