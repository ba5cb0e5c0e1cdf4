"""Where the dots are, from events or from frames."""
