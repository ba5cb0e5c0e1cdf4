"""Shear force: train a model on shear recordings, predict the force from any tracks."""
