"""Tools for processes that run at 1000 and 500 Hz: message pipes, numbers in shared memory, time, priority."""
