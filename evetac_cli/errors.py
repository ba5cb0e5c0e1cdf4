"""The errors of evetac, with their exit codes.

    EvetacError (1)
      UnavailableError    a file cannot be read now: another program uses it, or the system refuses
      MissingLibrary      a library that only some commands need is not installed
      InputError (2)      a file, flag or value given by the user is not what was expected
        ForeignFile       an HDF5 file that another program made
        SchemaError       the contents of a file violate its schema
        SceneError        a scene has an unknown name, or a value out of range
      DeviceError (3)     a camera or gripper failed
        DeviceTimeout     ... or did not answer in time

UnavailableError is not an InputError: code that catches InputError may replace the file, leave it out or report it as
invalid, but the contents of a file that could not be read are unknown.

Kernels raise ValueError, `check_range` and `check_whole` with a uniform message for a number out of range. The stage
that calls them knows the origin of the value and adds it to the message.

If files were made before an error or Ctrl-C, the exception carries their results: see `attach_outcome`.
"""

import errno
import math
import os
import shlex
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from numbers import Integral
from pathlib import Path
from typing import Any, TypeVar

AnyError = TypeVar("AnyError", bound=BaseException)
INTERRUPTED = "interrupted: finished files are complete, those in progress were left out"
INTERNAL_ERROR = "internal error"  # prefix of unexpected errors; test programs search for it
MEMORY_HINT = "a shorter recording (evetac trim), or fewer --jobs"
# Libraries that only some commands need: the extra that installs them, and their import names.
EXTRAS = {
    "camera": ("dv_processing",),
    "convert": ("rosbags", "mcap", "faery", "lz4", "zstandard", "hdf5plugin", "pyarrow", "PIL", "av"),
    "plot": ("matplotlib", "bokeh", "PIL"),
    "cluster": ("dask", "distributed"),
    "robot": ("mujoco", "gymnasium", "cma"),
}
# The command that makes each kind of file; recordings are also made by grasp, trim and repair.
MADE_BY = {
    "recording": "record",
    "labels": "label",
    "tracks": "track",
    "features": "featurize",
    "model": "train",
    "force-model": "train-force",
    "touch": "predict-touch",
    "report": "evaluate",
}
MAKE_MODEL = "evetac train makes a model for this grid, from features of such recordings"
MOST_CHARACTERS = 600  # limit for a part of an error, so that long values of files or flags are not repeated in full


def shortened(text: str) -> str:
    """Return a text with its middle left out if it is longer than MOST_CHARACTERS."""
    if len(text) <= MOST_CHARACTERS:
        return text
    end = MOST_CHARACTERS // 4
    return f"{text[: MOST_CHARACTERS - end]} [...] {text[-end:]}"


def exit_code_words(code: int | None, message: str = "") -> str:
    """Return a description of how a process ended; "" if it still runs.

    code: exit code as in multiprocessing. message: the process's last message.
    """
    if code is None:
        return ""
    if code >= 0:
        return (
            f"exit code {code}: {message}"
            if message
            else f"exit code {code}{', without a message' if code == 0 else ''}"
        )
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return a hint that suggests the nearest of the valid names; empty if none is near."""
    from difflib import get_close_matches

    near = get_close_matches(name, list(names), n=1)
    return f"did you mean {near[0]}?" if near else ""


class EvetacError(Exception):
    """An error for the user: where it occurred, what was expected, what was found, and what to do.

    `kept` describes data that were saved in spite of the error; it may be set later.
    """

    exit_code = 1

    def __init__(
        self, message: str, *, where: str = "", expected: str = "", found: str = "", hint: str = "", kept: str = ""
    ) -> None:
        super().__init__(shortened(message))
        self.message, self.where, self.expected, self.found, self.hint = map(
            shortened, (message, where, expected, found, hint)
        )
        self.kept = kept

    def __str__(self) -> str:
        where = self.where.replace("\n", "\\n")  # a file name may contain lines that look like these
        lines = [f"{where}: {self.message}" if where else self.message]
        lines += [f"  expected: {self.expected}"] if self.expected else []
        lines += [f"  found:    {self.found}"] if self.found else []
        lines += [f"  try:      {self.hint}"] if self.hint else []
        lines += [f"  kept:     {self.kept}"] if self.kept else []
        return "\n".join(lines)


class InputError(EvetacError):
    """A file, flag or value given by the user is not what was expected (exit code 2)."""

    exit_code = 2


class UnavailableError(EvetacError):
    """A file cannot be read now, because another program uses it or the system refuses (exit code 1)."""


class MissingLibrary(EvetacError):
    """A library that only some commands need is not installed (exit code 1)."""


class ForeignFile(InputError):
    """An HDF5 file that another program made (exit code 2)."""


class SchemaError(InputError):
    """The contents of a file violate its schema (exit code 2)."""


class SceneError(InputError):
    """A scene has an unknown name, or a value out of range (exit code 2)."""


class DeviceError(EvetacError):
    """A camera or a gripper failed (exit code 3)."""

    exit_code = 3


class DeviceTimeout(DeviceError, TimeoutError):
    """A device did not answer in time (exit code 3)."""


# Errors from the operating system -------------------------------------------------------------------------------------

# Reasons that may be temporary and do not depend on the file's contents; others come from its name or damaged bytes.
BUSY = (errno.EAGAIN, errno.EBUSY, errno.ETXTBSY)
HINTS = {
    **dict.fromkeys(BUSY, "close it there, or wait until it is done"),
    **dict.fromkeys(
        (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP),
        "if no program is writing the file, HDF5_USE_FILE_LOCKING=FALSE before the command reads it without a lock",
    ),
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), "`ulimit -n` shows how many files may be open"),
}
PASSING = (
    *HINTS,
    *(errno.EACCES, errno.EPERM, errno.EIO, errno.ENODEV, errno.ENXIO, errno.EREMOTEIO, errno.ENOTCONN),
    *(errno.ETIMEDOUT, errno.EHOSTDOWN, errno.ESTALE, errno.ENOMEM, errno.ENOSPC, errno.EINTR),
)


def cannot_read(error: OSError, path: Path) -> EvetacError:
    """Return the error for a file that the system does not open or read.

    UnavailableError if the reason may be temporary; InputError if it is the name or the file itself.
    """
    number, reason = error.errno, error.strerror or str(error)
    if number is None or number not in PASSING:
        return InputError(f"cannot be read: {reason}", where=str(path))
    is_busy = number in BUSY
    # h5py replaces the reason with its own text
    message = "another program has this file open for writing" if is_busy else f"cannot be read: {os.strerror(number)}"
    found = _used_by(path) if is_busy else ""
    return UnavailableError(message, where=str(path), found=found, hint=HINTS.get(number, ""))


def changed_meanwhile(path: Path) -> UnavailableError:
    """Return the error for a file that changed while it was read, so that its data do not belong together."""
    hint = "wait until the program that writes it is done"
    return UnavailableError("changed while it was read", where=str(path), found=_used_by(path), hint=hint)


def _used_by(path: Path) -> str:
    programs = programs_using(path)
    return f"used by {', '.join(programs)}" if programs else ""


def programs_using(path: Path, proc: Path = Path("/proc")) -> list[str]:
    """Return this user's other programs that have a file open, as `name (pid)`; others are not visible."""
    wanted = path.resolve()
    users = []
    for entry in proc.glob("[0-9]*"):
        with suppress(OSError):
            is_open = any(link.readlink() == wanted for link in (entry / "fd").iterdir())
            if is_open and entry.name != str(os.getpid()):
                users.append(f"{(entry / 'comm').read_text().strip()} ({entry.name})")
    return sorted(users)


# Missing libraries ----------------------------------------------------------------------------------------------------


def missing_library(error: BaseException | None) -> EvetacError | None:
    """Return the error for a third-party library that is not installed; None for every other exception."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return None
    name = error.name.partition(".")[0]
    if name == __package__:
        return None
    extra = next((extra for extra, names in EXTRAS.items() if name in names), "")
    return missing_extra(f"the library {name} is not installed", extra)


def missing_extra(
    message: str, extra: str, *, where: str = "", error: Exception | None = None, found: str = ""
) -> MissingLibrary:
    """Return the error that a library of one of EXTRAS is missing or does not load (`error`), and how to install it."""
    found = found or (str(error) if error else "")
    return MissingLibrary(message, where=where, found=found, hint=install_hint(extra))


@contextmanager
def needs_extra(message: str, extra: str, where: str) -> Iterator[None]:
    """Turn the ImportError of a library of one of EXTRAS into MissingLibrary."""
    try:
        yield
    except ImportError as error:
        raise missing_extra(message, extra, where=where, error=error) from None


def install_hint(extra: str = "") -> str:
    """Return the command that installs evetac, with one of EXTRAS, into the environment in which it runs."""
    return f"in the clone of evetac: {pip('install')} {shlex.quote(f'.[{extra}]' if extra else '.')}"


def pip(action: str) -> str:
    """Return a pip command that acts on the environment in which this program runs."""
    return f"{shlex.quote(sys.executable)} -m pip {action}"


def made_by(kind: str) -> str:
    """Return a hint with the command that makes files of a kind."""
    return f"evetac {MADE_BY[kind]} makes {kind} files"


def attach_outcome(error: AnyError, outcome: Any) -> AnyError:
    """Attach to an error the Outcome of files that were made before it, and return the error."""
    vars(error)["outcome"] = outcome
    return error


def attached_outcome(error: BaseException) -> Any:
    """Return the Outcome attached to an error, or None."""
    return vars(error).get("outcome")


def error_dict(error: BaseException) -> dict[str, Any]:
    """Return an error as data for --json: its kind, its non-empty parts, and the exit status."""
    if isinstance(error, EvetacError):
        names = ("message", "where", "expected", "found", "hint", "kept")
        parts = {name: str(getattr(error, name)) for name in names if getattr(error, name)}
        return {"kind": type(error).__name__, **parts, "exit_status": error.exit_code}
    if isinstance(error, KeyboardInterrupt):
        return {"kind": "Interrupted", "message": str(error) or INTERRUPTED, "exit_status": 130}
    if isinstance(error, MemoryError):
        return {"kind": "MemoryError", "message": "not enough memory", "hint": MEMORY_HINT, "exit_status": 1}
    if isinstance(error, RecursionError):
        return {"kind": "RecursionError", "message": "nested too deeply", "exit_status": 1}
    if isinstance(error, OSError):
        where = {"where": shortened(str(error.filename))} if error.filename is not None else {}
        message = shortened(error.strerror or str(error) or type(error).__name__)
        return {"kind": type(error).__name__, "message": message, **where, "exit_status": InputError.exit_code}
    message = f"{INTERNAL_ERROR}: {type(error).__name__}: {shortened(str(error))}"
    return {"kind": "InternalError", "message": message, "exit_status": 1}


def check_range(
    name: str,
    value: float,
    low: float = 0.0,
    high: float = sys.float_info.max,
    unit: str = "",
    *,
    above: bool = False,
    below: bool = False,
) -> None:
    """Raise ValueError for NaN and for a number outside a range.

    The range includes both ends; `above` excludes low, `below` excludes high. Without `high`, every finite number
    starting at low is accepted.
    """
    if low < value < high or (value == low and not above) or (value == high and not below):
        return
    after = f" {unit}" if unit else ""
    expected = f"above {low:g}" if above else f"{low:g}"
    if high < sys.float_info.max:
        expected += f" to {'below ' if below else ''}{high:g}{after}"
    else:
        expected += f"{after}{'' if above else ' or more'}{', finite' if math.isinf(value) else ''}"
    raise ValueError(f"{name}: expected {expected}, found {value}")


def check_whole(name: str, value: int, low: int, high: int, *, step: int = 1) -> None:
    """Raise ValueError unless `value` is a whole number from low to high (both included) and a multiple of `step`."""
    if not isinstance(value, Integral):
        raise ValueError(f"{name}: expected a whole number, found {value!r}")
    check_range(name, value, low, high)
    if value % step:
        raise ValueError(f"{name}: expected {low} to {high} in steps of {step}, found {value}")
