"""What an event camera behind the gel sees: optics, edges, noise, and two cameras, one that scans and an ideal one."""
