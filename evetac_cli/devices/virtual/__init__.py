"""Virtual devices that speak the real wire protocols, with faults on demand; everything they show is simulated."""
