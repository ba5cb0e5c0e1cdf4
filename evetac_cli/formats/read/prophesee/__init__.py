"""Reader of Prophesee's files, RAW (EVT2, EVT2.1, EVT3) and DAT."""
