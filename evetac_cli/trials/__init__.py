"""The trials of `record` and `grasp`, resolved once, and one module or folder for each way to run them."""
