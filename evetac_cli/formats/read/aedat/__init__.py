"""Readers of AEDAT 2, 3.1 and 4, one module each, and of the packets of AEDAT 4."""
