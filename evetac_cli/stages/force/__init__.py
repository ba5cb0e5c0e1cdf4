"""Shear force: train a model on shear recordings, and predict the force from any tracks."""
