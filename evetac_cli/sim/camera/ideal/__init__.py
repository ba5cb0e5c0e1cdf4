"""An event camera without scans, with every event at the time of its crossing: the reference for the scanning one."""
