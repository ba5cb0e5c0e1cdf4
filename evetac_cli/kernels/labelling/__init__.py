"""Onset of slip in a recording: motion of the window against the gel."""
