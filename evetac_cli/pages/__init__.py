"""HTML pages: of one trial (view/) and of a whole study (report/)."""
