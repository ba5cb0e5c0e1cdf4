"""The settings of a simulation, read once from TOML into frozen types: scene, sensor, object, solver, and plan."""
