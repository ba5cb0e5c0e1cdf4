"""Slip detectors: features, inputs, networks, training, inference, metrics."""
