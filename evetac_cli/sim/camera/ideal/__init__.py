"""An event camera without scans, every event at the time of its crossing: the measure of the scanning one."""
