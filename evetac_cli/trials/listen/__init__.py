"""--listen: a robot's program starts, marks and stops the recordings of a series, each of them named by it.

The thread that records asks the desk (desk.py) once a slice what is wanted; requests come through the door (door.py),
whose address and token lie in a file (address.py). A program that breaks off its connection changes nothing: the trial
goes on, and whoever has the token may ask for it, mark it and stop it. What nobody stops ends after --seconds.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from evetac_cli import console, interrupts
from evetac_cli.devices.kept_camera import KeptCamera
from evetac_cli.errors import DeviceError, EvetacError, InputError, attach_outcome, attached_outcome
from evetac_cli.jobs import Job, Outcome, Rows, require_possible_name
from evetac_cli.store.hdf5.disk import existing_folder, missing_folders, remove_empty
from evetac_cli.trials.listen.desk import Desk
from evetac_cli.trials.session import ABORTED
from evetac_cli.trials.trial import OUTPUT, DeviceTrial

FILE_NAME = "evetac.listen"
WAIT_S = 0.1  # for a request, where no camera is read meanwhile
AnyTrial = TypeVar("AnyTrial", bound=DeviceTrial)


@dataclass(frozen=True)
class Listening(Job):
    """Trials that a robot's program names and starts, into a folder.

    first: what all of them are like; port: to listen at, 0 for one that the system chooses; longest_s: after which a
    trial ends that nobody stops, None where it ends by itself.
    """

    exclusive = True
    first: DeviceTrial
    port: int
    longest_s: float | None

    @property
    def folder(self) -> Path:
        """Where the recordings and the file with the address lie."""
        return self.output.parent


def listening(trials: Sequence[DeviceTrial], out: Path | None, port: int, longest_s: float | None = None) -> Listening:
    """The job of trials like the one that the flags describe; InputError where they describe several, or name a file.

    Each start names a trial, so that --count and several objects have no meaning.
    """
    if out is not None and out.suffix == ".h5":
        raise InputError("each start names its file", where="--out", expected="a folder", found=str(out))
    if len(trials) != 1:
        expected = "one object, and no --count: each start is a trial"
        raise InputError("several trials", where="--listen", expected=expected, found=f"{len(trials)} trials")
    (first,) = trials
    if first.plan is not None and first.plan.sensor_ranges is not None:
        expected = f"one sensor, as {first.plan.sensor_name}:0"
        raise InputError("each trial would have the same sensor", where="--sensor", expected=expected)
    return Listening(first.inputs, (out or Path()) / FILE_NAME, first, port, longest_s)


def listen(job: Listening, record: Callable[[Any, Desk], Outcome]) -> Outcome:
    """Record what is asked for until Ctrl-C, which is raised. record: makes a trial, (trial, desk) -> Outcome."""
    from evetac_cli.trials.listen.address import AddressFile  # with all that sockets need, here alone
    from evetac_cli.trials.listen.door import Door

    desk, first = Desk(job.longest_s), job.first
    rows: Rows = []
    kept = [camera for camera in first.cameras if isinstance(camera, KeptCamera)]
    simulated = first.shows_simulation
    try:
        with ExitStack() as opened:
            opened.enter_context(interrupts.signals_interrupt())
            opened.enter_context(_folder(job.folder))
            for camera in kept:
                opened.callback(camera.close)
                for note in camera.open(camera.settings, None, first.seeds()).camera.notes:
                    console.say(note)
            door = Door(desk.ask, job.port)
            opened.callback(door.close)
            file = AddressFile(job.output, door.port, door.token)
            opened.callback(file.remove)
            console.say(f"listening at 127.0.0.1:{door.port}; address and token are in {file.path}")
            number = 0
            while True:
                name = _next(desk, kept)
                trial = _named(first, job.folder, name, number)
                rows += _one(trial, desk, record)
                number += 1
                if desk.interrupted:
                    raise KeyboardInterrupt
    except KeyboardInterrupt as error:
        rows += getattr(attached_outcome(error), "rows", [])
        words = f"{error}; " if str(error) else ""
        said = f"{words}{len(rows)} recordings in {job.folder}"
        raise attach_outcome(KeyboardInterrupt(said), Outcome(rows, simulated)) from None


def _next(desk: Desk, kept: list[KeptCamera]) -> str:
    """The name of the next trial, once it is asked for; cameras that are kept open are read meanwhile."""
    while not (name := desk.wanted(0.0 if any(camera.is_open for camera in kept) else WAIT_S)):
        for camera in kept:
            try:
                camera.skip()
            except DeviceError as error:
                console.say(f"{error}; the next start opens it anew")
    return name


def _named(first: AnyTrial, folder: Path, name: str, number: int) -> AnyTrial:
    """A trial like the first, with this name and number."""
    stems = [f"-{camera.file_stem}" if len(first.cameras) > 1 else "" for camera in first.cameras]
    same = [stems[:place].count(stem) for place, stem in enumerate(stems)]
    files = tuple(
        folder / f"{name}{stem}{f'-{before + 1}' if before else ''}.{OUTPUT}.h5"
        for stem, before in zip(stems, same, strict=True)
    )
    return replace(first, output=files[0], files=files, series=(files,), taken=(), number=number)


def _one(trial: DeviceTrial, desk: Desk, record: Callable[[Any, Desk], Outcome]) -> Rows:
    """Record a trial, and say what became of it; an error in it ends no series. Returns its rows."""
    outcome: Outcome | None = None
    error: BaseException | None = None
    try:
        for output in trial.outputs:
            require_possible_name(output)
        outcome = record(trial, desk)
    except EvetacError as failed:
        error, outcome = failed, attached_outcome(failed)
    except BaseException as interrupted:
        error, outcome = interrupted, attached_outcome(interrupted)
        raise
    finally:
        rows = [] if outcome is None else outcome.rows
        file = str(Path(rows[0]["output"]).resolve()) if rows else None
        called_off = desk.called_off or ABORTED
        ended = str(rows[0]["ended"]) if rows else called_off if error is None else "nothing was recorded"
        slices = int(rows[0]["slices"]) if rows else 0
        words = _in_one_line(error) if isinstance(error, EvetacError) or (error and not rows) else ""
        desk.ended(file, ended, slices, words)
        console.say(f"{trial.output.name}: {words or f'{slices:,} slices, {ended}'}")
    return rows


def _in_one_line(error: BaseException | None) -> str:
    return "; ".join(" ".join(line.split()) for line in str(error).splitlines()) or type(error).__name__


@contextmanager
def _folder(folder: Path) -> Iterator[None]:
    """Make the folder where there is none, and remove it again where nothing was put into it."""
    existing_folder(folder)
    made = missing_folders(folder)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        remove_empty(made)
