"""Commands for users that no stage depends on: info, validate, repair, export, index, doctor, share."""
