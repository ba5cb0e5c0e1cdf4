"""The whole chain, from the settings of a recording to slip, force and grasps: error against run time."""
