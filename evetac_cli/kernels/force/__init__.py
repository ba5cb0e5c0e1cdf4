"""Shear force from displacements of dots: two models, and the training of one of them."""
