"""Virtual devices that speak the real wire protocols, with faults on request; everything they show is simulated.

They run in real time. A world's time waits while the machine is too slow (realtime/shared_time.py), except with a real
gripper. Prepared words, which serve to test loads, follow the host's clock unless they are given another clock.
"""
