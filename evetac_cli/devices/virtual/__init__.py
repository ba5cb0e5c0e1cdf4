"""Virtual devices that speak the real wire protocols, with faults on demand; everything they show is simulated.

They run in real time by the host's clock. `VirtualWorld.patient = True` and `PreparedWords.patient = True` give those
that are built afterwards a clock of their own, which waits while the machine is too slow (realtime/shared_time.py):
`world.time`, and `time` of the camera's driver. tests/conftest.py sets both for all tests.
"""
