"""Realism: measures by which two recordings differ, and how well a classifier distinguishes them."""
