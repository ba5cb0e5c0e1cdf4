"""Writers of event formats, one module each."""
