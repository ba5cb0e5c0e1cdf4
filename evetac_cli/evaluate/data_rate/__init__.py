"""evaluate data-rate: bytes of events against those of an RGB sensor."""
