"""Parameters of all commands: one frozen dataclass each, from which flags, config file and header are made."""
