"""What can go wrong, and the exit code it ends with.

    EvetacError (1)
      UnavailableError    a file cannot be read now, whatever it holds: another program has it, or the system refuses
      MissingLibrary      a library that only some commands need is not installed
      InputError (2)      a file, flag or value given by the user is not what was expected
        ForeignFile       an HDF5 file that another program made
        SchemaError       a file does not hold what its schema says
        SceneError        a scene names what does not exist, or a value out of range
      DeviceError (3)     a camera or gripper failed
        DeviceTimeout     ... or did not answer in time

Why UnavailableError is no InputError: whoever takes an InputError for "this file is wrong" may replace the file, leave
it out or call it invalid. Of a file that could not be looked at nothing is known.

Kernels raise ValueError; the stage that calls them knows where the value came from and says so.

Where files were made all the same, an error or Ctrl-C takes along what came of them: `attach_outcome`.
"""

import errno
import os
import shlex
import shutil
import signal
import sys
from contextlib import suppress
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
    "convert": ("rosbags", "mcap", "faery", "lz4", "zstandard", "hdf5plugin", "pyarrow", "zarr", "PIL", "av"),
    "plot": ("matplotlib", "bokeh", "PIL", "tornado"),
    "view": ("rerun",),
    "cluster": ("dask", "distributed", "cryptography"),
    "log": ("tensorboard",),
    "robot": ("mujoco", "gymnasium", "cma"),
}
PACKAGE = Path(__file__).resolve().parent
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
    "touch": "predict-touch",
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
        return f"exit code {code}: {said}" if said else f"exit code {code}{', without a message' if code == 0 else ''}"
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


class UnavailableError(EvetacError):
    """A file cannot be read now, whatever it holds: another program has it, or the system refuses (exit code 1)."""


class MissingLibrary(EvetacError):
    """A library that only some commands need is not installed (exit code 1)."""


class ForeignFile(InputError):
    """An HDF5 file that another program made (exit code 2)."""


class SchemaError(InputError):
    """A file does not hold what its schema says (exit code 2)."""


class SceneError(InputError):
    """A scene names what does not exist, or a value out of range (exit code 2)."""


class DeviceError(EvetacError):
    """A camera or a gripper failed (exit code 3)."""

    exit_code = 3


class DeviceTimeout(DeviceError, TimeoutError):
    """A device did not answer in time (exit code 3)."""


# What the system refuses ----------------------------------------------------------------------------------------------

# Reasons that may pass, and say nothing of the file; others come from its name, or from damaged bytes in it.
BUSY = (errno.EAGAIN, errno.EBUSY, errno.ETXTBSY)
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
NO_RIGHT = (errno.EACCES, errno.EPERM)
TOO_MANY = (errno.EMFILE, errno.ENFILE)
DISK = (errno.EIO, errno.ENODEV, errno.ENXIO, errno.EREMOTEIO, errno.ENOTCONN, errno.ETIMEDOUT, errno.EHOSTDOWN)
PASSING = (*BUSY, *NO_LOCKS, *NO_RIGHT, *TOO_MANY, *DISK, errno.ESTALE, errno.ENOMEM, errno.ENOSPC, errno.EINTR)
MOST_PROGRAMS = 3  # that are named
NETWORK = ("nfs", "cifs", "smb", "lustre", "gpfs", "beegfs", "ceph", "glusterfs", "afs", "9p", "fuse.sshfs")
READ_WITHOUT_LOCKS = "HDF5_USE_FILE_LOCKING=FALSE in front of the command reads it without a lock"


def cannot_read(error: OSError, path: Path) -> EvetacError:
    """What it means that the system does not let a file be opened or read.

    UnavailableError where the reason may pass, InputError where it lies in the name or in the file.
    """
    where, said = str(path), error.strerror or str(error)
    if error.errno is not None and error.strerror is not None:
        said = os.strerror(error.errno)  # h5py puts its own words there
    number = error.errno
    if number not in PASSING:
        return InputError(f"cannot be read: {said}", where=where)
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
        hint = "`ulimit -n` says how many files may be open, `ulimit -n NUMBER` allows more"
    elif number in DISK:
        hint = "the disk, or the network behind it, fails: `dmesg` may say more"
    return UnavailableError(f"cannot be read: {said}", where=where, found=found, hint=hint)


def _busy(path: Path) -> UnavailableError:
    found = _used_by(path)
    hint = "close it there, or wait until it is done"
    if not found and _is_on_network(path):
        hint += f"; if no program on any computer is writing it, the lock is a leftover: {READ_WITHOUT_LOCKS}"
    return UnavailableError("another program has this file open for writing", where=str(path), found=found, hint=hint)


def changed_meanwhile(path: Path) -> UnavailableError:
    """That a file changed while it was read, so that what was read of it is of no one moment."""
    hint = "wait until the program that writes it is done"
    return UnavailableError("changed while it was read", where=str(path), found=_used_by(path), hint=hint)


def _used_by(path: Path) -> str:
    named = programs_using(path, writing=True)
    more = f" and {len(named) - MOST_PROGRAMS} more" if len(named) > MOST_PROGRAMS else ""
    return f"used by {', '.join(named[:MOST_PROGRAMS])}{more}" if named else ""


def programs_using(path: Path, proc: Path = Path("/proc"), *, writing: bool = False) -> list[str]:
    """Programs of this user, other than this one, that have a file open, as `name (pid)`; nobody can see the others.

    writing: only those that may write to it.
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
    """Whether an open file is open for writing, as /proc/PID/fdinfo says it: flags in octal digits."""
    flags = next(line.split()[1] for line in info.read_text().splitlines() if line.startswith("flags:"))
    return int(flags, 8) & os.O_ACCMODE != os.O_RDONLY


def _rights(path: Path) -> tuple[str, str]:
    """Who may do what with a file, and what to do where one may not read it; nothing where that is hidden."""
    with suppress(OSError, KeyError):
        status, owner = path.stat(), path.owner()
        own = status.st_uid == os.geteuid()
        hint = (
            f"chmod u+r {shlex.quote(str(path))}" if own else f"ask {owner}, whose file it is, for the right to read it"
        )
        return f"mode {status.st_mode & 0o777:04o}, owner {owner}", hint
    return "", "you have no permission to enter its folder"


def _is_on_network(path: Path, mounts: Path = Path("/proc/mounts")) -> bool:
    """Whether a file lies in a folder of another computer, as far as this one knows."""
    kind, longest = "", -1
    with suppress(OSError):
        inside = os.fsencode(path.resolve())
        for line in mounts.read_bytes().splitlines():
            _, place, type_, *_ = line.split(b" ")
            place = place.replace(b"\\040", b" ")
            if len(place) > longest and (inside + b"/").startswith(place.rstrip(b"/") + b"/"):
                kind, longest = type_.decode(errors="replace"), len(place)
    return kind.startswith(NETWORK)


# What is not installed ------------------------------------------------------------------------------------------------


def missing_library(error: BaseException | None) -> EvetacError | None:
    """A library of somebody else's that is not installed, in words; None for every other error."""
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
    """That a library of one of EXTRAS is not there, or does not load (`error`), and how to install it.

    otherwise: what can be done without it.
    """
    hint = install_hint(extra) + (f", or {otherwise}" if otherwise else "")
    return MissingLibrary(message, where=where, found=found or (str(error) if error else ""), hint=hint)


def install_hint(extra: str = "") -> str:
    """How to install evetac, and one of EXTRAS with it, into the environment that it runs in.

    From where it came: a clone that is at hand, the address that pip wrote down, else the package index by name. pipx
    and uv make the environment anew, so that extras which are there are named too.
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
    """How to call pip so that it works on the environment in which this program runs."""
    found, python = shutil.which("pip"), shlex.quote(sys.executable)
    if found is not None and Path(found).parent == Path(sys.executable).parent:
        return f"pip {action}"
    if find_spec("pip") is None and shutil.which("uv"):
        return f"uv pip {action} --python {python}"
    return f"{python} -m pip {action}"


def _origin() -> dict[str, Any]:
    """Where this very package was installed from, as pip writes it down (direct_url.json); nothing if it was not.

    Of a package index it is {"index": True}, for which pip writes nothing.
    """
    import json  # with what follows, for an error that is about to be said: `evetac --help` does without
    from importlib import metadata

    with suppress(metadata.PackageNotFoundError, ValueError, OSError):
        distribution = metadata.distribution("evetac")
        text = distribution.read_text("direct_url.json")
        origin: dict[str, Any] = json.loads(text) if text else {"index": True}
        # Where another copy comes first on the path, what is said of the installed one does not hold.
        if _local(str(origin.get("url", ""))) == PACKAGE.parent or (
            Path(str(distribution.locate_file(PACKAGE.name))).resolve() == PACKAGE
        ):
            return origin
    return {}


def _local(url: str) -> Path | None:
    """The file or folder that an address names; None for one elsewhere."""
    from urllib.parse import unquote

    return Path(unquote(url.removeprefix("file://"))).resolve() if url.startswith("file:///") else None


def _address(origin: dict[str, Any]) -> str:
    """An address as pip takes it behind a name (PEP 508), ` @ URL`; empty for a package index."""
    if "url" not in origin:
        return ""
    version = origin.get("vcs_info", {})
    system = f"{version['vcs']}+" if "vcs" in version else ""
    wanted = version.get("requested_revision") or version.get("commit_id")
    place = f"#subdirectory={origin['subdirectory']}" if "subdirectory" in origin else ""
    return f" @ {system}{origin['url']}{f'@{wanted}' if wanted else ''}{place}"


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
