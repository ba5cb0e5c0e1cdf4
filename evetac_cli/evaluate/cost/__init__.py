"""evaluate cost: error against run time, part by part."""
