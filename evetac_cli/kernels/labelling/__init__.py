"""Labelling: onset of slip in a recording, from the motion of the window relative to the gel."""
