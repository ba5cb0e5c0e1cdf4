"""What can go wrong, and the exit code it ends with.

    EvetacError (1)
      InputError (2)      a file, flag or value given by the user is not what was expected
        SchemaError       a file does not hold what its schema says
        SceneError        a scene names what does not exist, or a value out of range
      DeviceError (3)     a camera or gripper failed
        DeviceTimeout     ... or did not answer in time

Kernels raise ValueError; the stage that calls them knows where the value came from and says so.

Where files were made all the same, an error or Ctrl-C takes along what came of them: `attach_outcome`.
"""

import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

AnyError = TypeVar("AnyError", bound=BaseException)
INTERRUPTED = "interrupted: finished files are complete, the one in progress was left out"
INTERNAL_ERROR = "internal error"  # how what nobody foresaw begins: programs that try evetac out look for it
MEMORY_HINT = "a shorter recording (evetac trim), or fewer --jobs"
# Libraries that only some commands need: the extra that installs each, and what it is imported as.
EXTRAS = {
    "camera": ("dv_processing",),
    "convert": ("rosbags", "mcap", "faery", "lz4", "zstandard", "hdf5plugin", "pyarrow", "PIL", "av"),
    "plot": ("matplotlib", "bokeh", "PIL", "tornado"),
    "view": ("rerun",),
    "cluster": ("dask", "distributed", "cryptography"),
    "log": ("tensorboard",),
    "robot": ("mujoco", "gymnasium", "cma"),
}
# What pipx and uv leave in the environment of a program that they installed, and how each installs it anew.
INSTALLERS = {"pipx_metadata.json": "pipx install --force", "uv-receipt.toml": "uv tool install --force"}
# The commands that make each kind of file; a recording is made by grasp, trim and repair, too.
MADE_BY = {
    "recording": "record",
    "labels": "label",
    "tracks": "track",
    "features": "featurize",
    "model": "train",
    "force-model": "train-force",
    "forces": "predict-force",
    "report": "evaluate",
}
MAKE_MODEL = "evetac train makes a model for this grid, from features of such recordings"
MOST_CHARACTERS = 600  # of a part of an error: what a file or flag holds is quoted, not repeated


def shortened(text: str) -> str:
    """A text of any length with its middle left out where it is longer than MOST_CHARACTERS."""
    if len(text) <= MOST_CHARACTERS:
        return text
    end = MOST_CHARACTERS // 4
    return f"{text[: MOST_CHARACTERS - end]} [...] {text[-end:]}"


def exit_code_words(code: int | None, said: str = "") -> str:
    """How a process ended, in words; "" if it still runs. code: as of multiprocessing; said: its own last words."""
    if code is None:
        return ""
    if code >= 0:
        return f"exit code {code}: {said}" if said else f"exit code {code}{', without a word' if code == 0 else ''}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


class EvetacError(Exception):
    """An error to show to the user in one paragraph: where, what was expected, what was found, what to do.

    `kept` says what there is all the same; whoever knows it may set it later.
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
        where = self.where.replace("\n", "\\n")  # a file's name may hold lines that look like ours
        lines = [f"{where}: {self.message}" if where else self.message]
        lines += [f"  expected: {self.expected}"] if self.expected else []
        lines += [f"  found:    {self.found}"] if self.found else []
        lines += [f"  try:      {self.hint}"] if self.hint else []
        lines += [f"  kept:     {self.kept}"] if self.kept else []
        return "\n".join(lines)


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


def missing_library(error: BaseException | None) -> EvetacError | None:
    """A library of somebody else's that is not installed, in words; None for every other error."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return None
    name = error.name.partition(".")[0]
    if name == __package__:
        return None
    extra = next((extra for extra, names in EXTRAS.items() if name in names), "")
    return EvetacError(f"the library {name} is not installed", hint=install_hint(extra))


def install_hint(extra: str = "") -> str:
    """How to install evetac, and one of EXTRAS with it, into the environment that it runs in.

    From a clone, for there is no distribution of this name on the package index. pipx and uv make the environment anew,
    so that extras which are there are named too.
    """
    way = next((way for mark, way in INSTALLERS.items() if Path(sys.prefix, mark).is_file()), None)
    there = [name for name, modules in EXTRAS.items() if all(map(find_spec, modules))] if way else []
    extras = ",".join(dict.fromkeys([*there, extra] if extra else there))
    return f"in the clone: {way or 'pip install'} " + (f"'.[{extras}]'" if extras else ".")


def made_by(kind: str) -> str:
    """Which command makes files of a kind, as a hint says it."""
    return f"evetac {MADE_BY[kind]} makes {kind} files"


def attach_outcome(error: AnyError, outcome: Any) -> AnyError:
    """Let an error take along the Outcome of what was made all the same."""
    vars(error)["outcome"] = outcome
    return error


def attached_outcome(error: BaseException) -> Any:
    """The Outcome that an error took along, or None."""
    return vars(error).get("outcome")


def error_dict(error: BaseException) -> dict[str, Any]:
    """An error as data, for --json: its kind, its parts as far as there are any, the exit status."""
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
        named = {"where": shortened(str(error.filename))} if error.filename is not None else {}
        message = shortened(error.strerror or str(error) or type(error).__name__)
        return {"kind": type(error).__name__, "message": message, **named, "exit_status": InputError.exit_code}
    message = f"{INTERNAL_ERROR}: {type(error).__name__}: {shortened(str(error))}"
    return {"kind": "InternalError", "message": message, "exit_status": 1}
