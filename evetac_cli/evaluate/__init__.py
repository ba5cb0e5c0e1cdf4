"""One folder per subject of `evaluate`: each reads stage files and returns flat rows, which a report file stores."""
