"""Identify: what a simulator needs to know of a camera, its gel and its gripper, from recordings, with intervals."""
