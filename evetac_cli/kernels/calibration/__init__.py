"""Where the dots of a gel are at rest: a picture from events, dots in it, the grid they form."""
