"""Realism: by which figures two recordings differ, and how well they can be told apart."""
