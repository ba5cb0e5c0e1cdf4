"""--listen: a robot's program starts, marks and stops the recordings of a series, and names each of them.

The recording thread looks for commands once per slice (trial_requests.py). They arrive at a port (request_server.py),
whose address and token are stored in a file. A program that closes its connection changes nothing: the trial
continues, and any program with the token may query, mark and stop it. A trial that no program stops ends after
--seconds.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from evetac_cli import console, interrupts
from evetac_cli.devices.series_camera import SeriesCamera
from evetac_cli.errors import DeviceError, EvetacError, InputError, attach_outcome, attached_outcome
from evetac_cli.jobs import Job, Outcome, Rows, require_possible_name
from evetac_cli.store.hdf5.disk import existing_folder, missing_folders, remove_empty
from evetac_cli.trials.listen.trial_requests import TrialRequests
from evetac_cli.trials.session import ABORTED
from evetac_cli.trials.trial import OUTPUT, DeviceTrial

FILE_NAME = "evetac.listen"
WAIT_S = 0.1  # how long to wait for a request while no camera is read
AnyTrial = TypeVar("AnyTrial", bound=DeviceTrial)


@dataclass(frozen=True)
class Listening(Job):
    """Trials that a robot's program names and starts, in one folder.

    first: the template of all trials; port: to listen at, 0 for one that the system chooses; longest_s: the time after
    which an unstopped trial ends, None if it ends by itself.
    """

    exclusive = True
    first: DeviceTrial
    port: int
    longest_s: float | None

    @property
    def folder(self) -> Path:
        """The folder of the recordings and of the address file."""
        return self.output.parent


def listening(trials: Sequence[DeviceTrial], out: Path | None, port: int, longest_s: float | None = None) -> Listening:
    """Return the job of trials like the one that the flags describe; InputError for several trials, or a file name.

    Each start names its own trial, so --count and several objects have no meaning.
    """
    if out is not None and out.suffix == ".h5":
        raise InputError("each start names its file", where="--out", expected="a folder", found=str(out))
    if len(trials) != 1:
        expected = "one object, and no --count: each start is a trial"
        raise InputError("several trials", where="--listen", expected=expected, found=f"{len(trials)} trials")
    (first,) = trials
    if first.plan is not None and first.plan.sensor_ranges is not None:
        expected = f"one sensor, for example {first.plan.sensor_name}:0"
        raise InputError("each trial would have the same sensor", where="--sensor", expected=expected)
    return Listening(first.inputs, (out or Path()) / FILE_NAME, first, port, longest_s)


def listen(job: Listening, record: Callable[..., Outcome]) -> Outcome:
    """Record the requested trials until Ctrl-C, which is raised. record: makes a trial, (trial, requests=...)."""
    # loads the socket libraries, only here
    from evetac_cli.trials.listen.request_server import RequestServer, address_file

    requests, first = TrialRequests(job.longest_s), job.first
    rows: Rows = []
    kept = [camera for camera in first.cameras if isinstance(camera, SeriesCamera)]
    simulated = first.shows_simulation
    try:
        with ExitStack() as opened:
            opened.enter_context(interrupts.signals_interrupt())
            opened.enter_context(_folder(job.folder))
            for camera in kept:
                opened.callback(camera.close)
                for note in camera.open(camera.settings, None, first.seeds()).camera.notes:
                    console.say(note)
            server = RequestServer(requests.ask, job.port)
            opened.callback(server.close)
            opened.enter_context(address_file(job.output, server))
            console.say(f"listening at 127.0.0.1:{server.port}; address and token are in {job.output}")
            number = 0
            while True:
                name = _next(requests, kept)
                trial = _trial_like(first, job.folder, name, number)
                rows += _one(trial, requests, record)
                number += 1
                if requests.interrupted:
                    raise KeyboardInterrupt
    except KeyboardInterrupt as error:
        rows += getattr(attached_outcome(error), "rows", [])
        words = f"{error}; " if str(error) else ""
        summary = f"{words}{len(rows)} recordings in {job.folder}"
        raise attach_outcome(KeyboardInterrupt(summary), Outcome(rows, simulated)) from None


def _next(requests: TrialRequests, kept: list[SeriesCamera]) -> str:
    """Return the name of the next trial once it is requested; meanwhile kept cameras are read."""
    while not (name := requests.wanted(0.0 if any(camera.is_open for camera in kept) else WAIT_S)):
        for camera in kept:
            try:
                camera.skip()
            except DeviceError as error:
                console.say(f"{error}; the next start opens it again")
    return name


def _trial_like(first: AnyTrial, folder: Path, name: str, number: int) -> AnyTrial:
    """Return a trial like the first, with this name and number."""
    stems = [f"-{camera.file_stem}" if len(first.cameras) > 1 else "" for camera in first.cameras]
    same = [stems[:place].count(stem) for place, stem in enumerate(stems)]
    files = tuple(
        folder / f"{name}{stem}{f'-{before + 1}' if before else ''}.{OUTPUT}.h5"
        for stem, before in zip(stems, same, strict=True)
    )
    return replace(first, output=files[0], files=files, series=(files,), taken=(), number=number)


def _one(trial: DeviceTrial, requests: TrialRequests, record: Callable[..., Outcome]) -> Rows:
    """Record a trial, report its outcome, and return its rows; an error in it does not end the series."""
    outcome: Outcome | None = None
    error: BaseException | None = None
    try:
        for output in trial.outputs:
            require_possible_name(output)
        outcome = record(trial, requests=requests)
    except EvetacError as failed:
        error, outcome = failed, attached_outcome(failed)
    except BaseException as interrupted:
        error, outcome = interrupted, attached_outcome(interrupted)
        raise
    finally:
        rows = [] if outcome is None else outcome.rows
        file = str(Path(rows[0]["output"]).resolve()) if rows else None
        end_reason = requests.end_reason or ABORTED
        ended = str(rows[0]["ended"]) if rows else end_reason if error is None else "nothing was recorded"
        slices = int(rows[0]["slices"]) if rows else 0
        words = _in_one_line(error) if isinstance(error, EvetacError) or (error and not rows) else ""
        requests.ended(file, ended, slices, words)
        console.say(f"{trial.output.name}: {words or f'{slices:,} slices, {ended}'}")
    return rows


def _in_one_line(error: BaseException | None) -> str:
    return "; ".join(" ".join(line.split()) for line in str(error).splitlines()) or type(error).__name__


@contextmanager
def _folder(folder: Path) -> Iterator[None]:
    """Create the folder if necessary, and remove it again if nothing was written to it."""
    existing_folder(folder)
    new_folders = missing_folders(folder)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        remove_empty(new_folders)
