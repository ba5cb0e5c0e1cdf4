"""evaluate vibration: the frequency at which the gel vibrates."""
