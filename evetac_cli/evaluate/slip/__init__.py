"""evaluate slip: timing, F1 and warnings of slip detectors."""
