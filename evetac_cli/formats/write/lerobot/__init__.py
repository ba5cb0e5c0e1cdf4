"""LeRobotDataset v3.0: trials as episodes, brought to a chosen rate, with statistics and a data card."""
