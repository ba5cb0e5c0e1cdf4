"""Export to LeRobotDataset v3.0: trials as episodes at a chosen frame rate, with statistics and a data card."""
