"""Simulations of scenes: a gripped object, a pressed face, a rubbed edge, and a speaker that vibrates."""
