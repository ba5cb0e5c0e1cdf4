"""Processes that run at 1000 and 500 Hz: message pipes, shared status, scheduling."""
