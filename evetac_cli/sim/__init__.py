"""What a scene may name: gel, contact, gripper, optics, camera."""
