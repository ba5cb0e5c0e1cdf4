"""What `record` and `grasp` do: their trials, resolved once, and one module or folder for each way to run one."""
