"""The simulated cameras: error against run time, extreme cases."""
