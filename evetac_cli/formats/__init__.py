"""Other people's event files: one table of formats that are read, one of formats that are written."""
