"""Identify: what a simulator needs to know of a camera and its gel, estimated from events, each with an interval."""
