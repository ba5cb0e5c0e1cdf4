"""What `evaluate cost` and `evaluate stability` run: error against run time, stiff and extreme cases."""
