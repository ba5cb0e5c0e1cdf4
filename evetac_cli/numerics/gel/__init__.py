"""The simulated gel: its trial, other solvers to compare with, error against run time, extreme cases."""
