"""The dot tracker: error against run time, extreme cases."""
