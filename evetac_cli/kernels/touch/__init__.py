"""Touch maps: from the motion of a gel's dots to what touches it, where, how hard and in which direction."""
