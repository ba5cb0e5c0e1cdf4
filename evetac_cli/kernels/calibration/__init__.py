"""Calibration: an image of the gel at rest from events, the dots in it, and the grid that they form."""
