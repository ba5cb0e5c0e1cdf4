"""evaluate grasp: outcomes of grasps, and their grip forces."""
