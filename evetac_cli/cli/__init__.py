"""The command line: commands and their flags, exit codes, and how jobs are run."""
