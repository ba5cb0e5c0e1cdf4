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

Kernels raise ValueError. The stage that calls them knows the origin of the value and adds it to the message.

If files were made before an error or Ctrl-C, the exception carries their results: see `attach_outcome`.
"""

import errno
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Iterable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

AnyError = TypeVar("AnyError", bound=BaseException)
INTERRUPTED = "interrupted: finished files are complete, those in progress were left out"
INTERNAL_ERROR = "internal error"  # prefix of unexpected errors; test programs search for it
MEMORY_HINT = "a shorter recording (evetac trim), or fewer --jobs"
# Libraries that only some commands need: the extra that installs them, and their import names.
EXTRAS = {
    "camera": ("dv_processing",),
    "convert": ("rosbags", "mcap", "faery", "lz4", "zstandard", "hdf5plugin", "pyarrow", "zarr", "PIL", "av"),
    "plot": ("matplotlib", "bokeh", "PIL"),
    "view": ("rerun",),
    "cluster": ("dask", "distributed", "cryptography"),
    "log": ("tensorboard",),
    "robot": ("mujoco", "gymnasium", "cma"),
}
PACKAGE = Path(__file__).resolve().parent
# Files that pipx and uv leave in the environment of a program that they installed, and how each reinstalls it.
INSTALLERS = {"pipx_metadata.json": "pipx install --force", "uv-receipt.toml": "uv tool install --force"}
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
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
NO_RIGHT = (errno.EACCES, errno.EPERM)
TOO_MANY = (errno.EMFILE, errno.ENFILE)
DISK = (errno.EIO, errno.ENODEV, errno.ENXIO, errno.EREMOTEIO, errno.ENOTCONN, errno.ETIMEDOUT, errno.EHOSTDOWN)
PASSING = (*BUSY, *NO_LOCKS, *NO_RIGHT, *TOO_MANY, *DISK, errno.ESTALE, errno.ENOMEM, errno.ENOSPC, errno.EINTR)
MOST_PROGRAMS = 3  # listed in a message
NETWORK = ("nfs", "cifs", "smb", "lustre", "gpfs", "beegfs", "ceph", "glusterfs", "afs", "9p", "fuse.sshfs")
READ_WITHOUT_LOCKS = "HDF5_USE_FILE_LOCKING=FALSE in front of the command reads it without a lock"


def cannot_read(error: OSError, path: Path) -> EvetacError:
    """Return the error for a file that the system does not open or read.

    UnavailableError if the reason may be temporary; InputError if it is the name or the file itself.
    """
    where, reason = str(path), error.strerror or str(error)
    if error.errno is not None and error.strerror is not None:
        reason = os.strerror(error.errno)  # h5py replaces it with its own text
    number = error.errno
    if number not in PASSING:
        return InputError(f"cannot be read: {reason}", where=where)
    if number in BUSY:
        return _busy(path)
    found = hint = ""
    if number in NO_LOCKS:
        hint = f"this storage has no locks; if no program is writing the file, {READ_WITHOUT_LOCKS}"
    elif number in NO_RIGHT:
        found, hint = _rights(path)
    elif number == errno.ESTALE:
        hint = "the network folder changed on its server: try again, or mount it again"
    elif number in TOO_MANY:
        hint = "`ulimit -n` shows how many files may be open, `ulimit -n NUMBER` allows more"
    elif number in DISK:
        hint = "the disk or its network connection fails: `dmesg` may show more"
    return UnavailableError(f"cannot be read: {reason}", where=where, found=found, hint=hint)


def _busy(path: Path) -> UnavailableError:
    found = _used_by(path)
    hint = "close it there, or wait until it is done"
    if not found and _is_on_network(path):
        hint += f"; if no program on any computer is writing it, the lock is a leftover: {READ_WITHOUT_LOCKS}"
    return UnavailableError("another program has this file open for writing", where=str(path), found=found, hint=hint)


def changed_meanwhile(path: Path) -> UnavailableError:
    """Return the error for a file that changed while it was read, so that its data do not belong together."""
    hint = "wait until the program that writes it is done"
    return UnavailableError("changed while it was read", where=str(path), found=_used_by(path), hint=hint)


def _used_by(path: Path) -> str:
    programs = programs_using(path, writing=True)
    more = f" and {len(programs) - MOST_PROGRAMS} more" if len(programs) > MOST_PROGRAMS else ""
    return f"used by {', '.join(programs[:MOST_PROGRAMS])}{more}" if programs else ""


def programs_using(path: Path, proc: Path = Path("/proc"), *, writing: bool = False) -> list[str]:
    """Return this user's other programs that have a file open, as `name (pid)`; other users' programs are not visible.

    writing: return only those that may write to the file.
    """
    wanted = path.resolve()
    users = []
    for entry in proc.glob("[0-9]*"):
        with suppress(OSError, ValueError):
            opened = [link for link in (entry / "fd").iterdir() if link.readlink() == wanted]
            if writing:
                opened = [link for link in opened if _may_write(entry / "fdinfo" / link.name)]
            if opened and entry.name != str(os.getpid()):
                users.append(f"{(entry / 'comm').read_text().strip()} ({entry.name})")
    return sorted(users)


def _may_write(info: Path) -> bool:
    """Whether an open file is open for writing, by the octal flags in /proc/PID/fdinfo."""
    flags = next(line.split()[1] for line in info.read_text().splitlines() if line.startswith("flags:"))
    return int(flags, 8) & os.O_ACCMODE != os.O_RDONLY


def _rights(path: Path) -> tuple[str, str]:
    """Return the mode and owner of a file, and how to get permission to read it; less if these are not visible."""
    with suppress(OSError, KeyError):
        status, owner = path.stat(), path.owner()
        own = status.st_uid == os.geteuid()
        hint = f"chmod u+r {shlex.quote(str(path))}" if own else f"ask {owner}, the file's owner, for read permission"
        return f"mode {status.st_mode & 0o777:04o}, owner {owner}", hint
    return "", "you have no permission to enter its folder"


def _is_on_network(path: Path, mounts: Path = Path("/proc/mounts")) -> bool:
    """Whether a file is on a network file system, according to the list of mounts."""
    kind, longest = "", -1
    with suppress(OSError):
        inside = os.fsencode(path.resolve())
        for line in mounts.read_bytes().splitlines():
            _, place, type_, *_ = line.split(b" ")
            place = place.replace(b"\\040", b" ")
            if len(place) > longest and (inside + b"/").startswith(place.rstrip(b"/") + b"/"):
                kind, longest = type_.decode(errors="replace"), len(place)
    return kind.startswith(NETWORK)


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
    message: str, extra: str, *, where: str = "", error: Exception | None = None, found: str = "", otherwise: str = ""
) -> MissingLibrary:
    """Return the error that a library of one of EXTRAS is missing or does not load (`error`), and how to install it.

    otherwise: an alternative that works without the library.
    """
    hint = install_hint(extra) + (f", or {otherwise}" if otherwise else "")
    return MissingLibrary(message, where=where, found=found or (str(error) if error else ""), hint=hint)


def install_hint(extra: str = "") -> str:
    """Return the command that installs evetac, with one of EXTRAS, into the environment in which it runs.

    The source is the same as before: a local clone, the address that pip recorded, or else the package index. pipx and
    uv rebuild the environment, so the extras that are already installed are included.
    """
    way = next((way for mark, way in INSTALLERS.items() if Path(sys.prefix, mark).is_file()), "")
    there = [name for name, modules in EXTRAS.items() if all(map(find_spec, modules))] if way else []
    listed = ",".join(dict.fromkeys([*there, extra] if extra else there))
    extras = f"[{listed}]" if listed else ""
    origin = _origin()
    local = _local(str(origin.get("url", "")))
    clone = next((one for one in (PACKAGE.parent, local) if one and (one / "pyproject.toml").is_file()), None)
    editable = "--editable " if not way and clone == local and origin.get("dir_info", {}).get("editable") else ""
    way = way or pip("install")
    if clone is not None and not _is_here(clone):
        return f"{way} {editable}{shlex.quote(f'{clone}{extras}')}"
    if clone is not None or not origin or (local is not None and not local.is_file()):
        which = "the clone" if clone is not None else "a clone of evetac"
        return f"in {which}: {way} {editable}{shlex.quote(f'.{extras}')}"
    return f"{way} {shlex.quote(f'evetac{extras}{_address(origin)}')}"


def _is_here(folder: Path) -> bool:
    try:
        return folder.samefile(os.curdir)
    except OSError:  # the working folder is gone
        return False


def pip(action: str) -> str:
    """Return a pip command that acts on the environment in which this program runs."""
    found, python = shutil.which("pip"), shlex.quote(sys.executable)
    if found is not None and Path(found).parent == Path(sys.executable).parent:
        return f"pip {action}"
    if find_spec("pip") is None and shutil.which("uv"):
        return f"uv pip {action} --python {python}"
    return f"{python} -m pip {action}"


def _origin() -> dict[str, Any]:
    """Return the origin of this installed package, as pip recorded it (direct_url.json); empty if it is not installed.

    For a package index it is {"index": True}, since pip records nothing then.
    """
    import json  # imported here: only needed for an error message, not by `evetac --help`
    from importlib import metadata

    with suppress(metadata.PackageNotFoundError, ValueError, OSError):
        distribution = metadata.distribution("evetac")
        text = distribution.read_text("direct_url.json")
        origin: dict[str, Any] = json.loads(text) if text else {"index": True}
        # If another copy comes first on the path, the record of the installed one does not apply.
        if _local(str(origin.get("url", ""))) == PACKAGE.parent or (
            Path(str(distribution.locate_file(PACKAGE.name))).resolve() == PACKAGE
        ):
            return origin
    return {}


def _local(url: str) -> Path | None:
    """Return the path of a file:// address; None for any other address."""
    from urllib.parse import unquote

    return Path(unquote(url.removeprefix("file://"))).resolve() if url.startswith("file:///") else None


def _address(origin: dict[str, Any]) -> str:
    """Return an address in the form that follows a name for pip (PEP 508), ` @ URL`; empty for a package index."""
    if "url" not in origin:
        return ""
    version = origin.get("vcs_info", {})
    system = f"{version['vcs']}+" if "vcs" in version else ""
    wanted = version.get("requested_revision") or version.get("commit_id")
    place = f"#subdirectory={origin['subdirectory']}" if "subdirectory" in origin else ""
    return f" @ {system}{origin['url']}{f'@{wanted}' if wanted else ''}{place}"


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
