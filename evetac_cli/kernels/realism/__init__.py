"""Realism: how far a simulated recording may be told from another one."""
