"""Readers of AEDAT 2, 3.1 and 4, a module each, and the packets that AEDAT 4 is made of."""
