"""A page in the browser that shows a recording while it is made: what it reads in shared memory, and who serves it."""
