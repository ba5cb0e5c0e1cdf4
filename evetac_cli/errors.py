"""What can go wrong, and the exit code it ends with.

    EvetacError (1)
      InputError (2)      a file, flag or value given by the user is not what was expected
        SchemaError       a file does not hold what its schema says
        SceneError        a scene names what does not exist, or a value out of range
      DeviceError (3)     a camera or gripper failed
        DeviceTimeout     ... or did not answer in time

Kernels raise ValueError; the stage that calls them knows where the value came from and says so.
"""


class EvetacError(Exception):
    """An error to show to the user in one paragraph: where, what was expected, what was found, what to do."""

    exit_code = 1

    def __init__(self, message: str, *, where: str = "", expected: str = "", found: str = "", hint: str = "") -> None:
        lines = [f"{where}: {message}" if where else message]
        lines += [f"  expected: {expected}"] if expected else []
        lines += [f"  found:    {found}"] if found else []
        lines += [f"  try:      {hint}"] if hint else []
        super().__init__("\n".join(lines))


class InputError(EvetacError):
    """A file, flag or value given by the user is not what was expected (exit code 2)."""

    exit_code = 2


class SchemaError(InputError):
    """A file does not hold what its schema says (exit code 2)."""


class SceneError(InputError):
    """A scene names what does not exist, or a value out of range (exit code 2)."""


class DeviceError(EvetacError):
    """A camera or a gripper failed (exit code 3)."""

    exit_code = 3


class DeviceTimeout(DeviceError, TimeoutError):
    """A device did not answer in time (exit code 3)."""
