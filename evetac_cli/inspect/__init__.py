"""For people, never needed by a stage: info, validate."""
