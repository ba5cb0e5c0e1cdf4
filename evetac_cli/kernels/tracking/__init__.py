"""Tracking: positions of the dots, from events or from frames."""
