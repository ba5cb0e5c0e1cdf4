"""Identify what a simulator needs to know about a camera, its gel and its gripper, from recordings, with intervals."""
