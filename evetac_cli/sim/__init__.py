"""The simulator: gel, contact, gripper, optics and camera of a scene."""
