"""Short simulated grasps: what delays and other detectors cost, extreme cases."""
