"""What processes that run at 1000 and 500 Hz share: message pipes, numbers in shared memory, time, priority."""
