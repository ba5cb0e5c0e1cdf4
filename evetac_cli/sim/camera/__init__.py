"""The event camera behind the gel: optics, edges, noise, and two cameras, one that scans and an ideal one."""
