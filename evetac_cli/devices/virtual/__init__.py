"""Virtual devices that speak the real wire protocols, with faults on demand; everything they show is simulated.

They run in real time. The time of a world waits while the machine is too slow (realtime/shared_time.py), but beside a
real gripper; prepared words, with which loads are tried, come by the host's clock, unless they are given another.
"""
