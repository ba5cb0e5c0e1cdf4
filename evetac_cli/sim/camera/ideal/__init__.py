"""An event camera without scans: every event at the time at which its threshold is crossed."""
