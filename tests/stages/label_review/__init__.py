"""Tests of label --review."""
