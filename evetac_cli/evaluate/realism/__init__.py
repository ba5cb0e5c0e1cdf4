"""evaluate realism: a simulated recording against a real one."""
