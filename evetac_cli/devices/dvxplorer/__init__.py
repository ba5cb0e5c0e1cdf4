"""The iniVation DVXplorer Mini over USB: protocol, event words, reader thread and driver."""
