"""The event camera behind the gel: optics, edges, noise, and the camera, which scans."""
