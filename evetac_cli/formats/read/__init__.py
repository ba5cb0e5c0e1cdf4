"""Readers of event formats, one module each, and the checks that all imported events pass through."""
