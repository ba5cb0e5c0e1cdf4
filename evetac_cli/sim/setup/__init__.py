"""What is simulated, read once from TOML into frozen types: scene, sensor, object, solver, and the plan of a trial."""
