"""Error, run time and stability of the simulated gel and camera."""
