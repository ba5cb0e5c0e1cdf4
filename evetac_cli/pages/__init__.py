"""Pages for people: of a trial (view/) and of a whole study (report/)."""
