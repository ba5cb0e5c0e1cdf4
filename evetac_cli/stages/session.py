"""A trial with devices, from checks to the final message: what `record` and `grasp` in real time share.

Before a device is touched: whether the outputs may be written and fit on the disk, and what a dry run shows. While it
runs: Ctrl-C ends it between slices. Afterwards: the file is joined, and an error or Ctrl-C goes on with what was saved.
"""

import signal
import threading
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices import losses
from evetac_cli.errors import DeviceError, EvetacError, InputError, attach_outcome
from evetac_cli.jobs import Outcome
from evetac_cli.stages.trials import OUTPUT, DeviceTrial, Trial
from evetac_cli.store.disk import require_room
from evetac_cli.store.provenance import Header, Recipe
from evetac_cli.store.segments import RecordingWriter, refuse_leftover

INTERRUPTED = "interrupted"
LOST = "capture/lost/"
BYTES_AN_EVENT = 2 * 13  # in its segment and, at worst, again in the joined file


def refuse_taken(trial: DeviceTrial, *, again: str, hint: str, force: bool, resume: bool = False) -> None:
    """InputError where an output exists, or what broke off waits for repair: nothing moves for what is refused.

    Of this trial, or, unless the series goes on, of any before the first. again: what cannot be made again.
    """
    for output in trial.outputs:
        if output.exists() and not force:
            raise InputError(f"the output exists, and {again} cannot be made again", where=str(output), hint=hint)
        refuse_leftover(output)
    if trial.taken and not (force or resume):
        raise InputError(
            "this trial was not started, because others of the series exist already",
            where=str(trial.output),
            found=", ".join(map(str, trial.taken)),
            hint=hint,
        )


def needed_bytes(events_per_s: float, seconds: float, files: int = 1) -> float:
    """Room that recordings may need on their disk."""
    return events_per_s * seconds * BYTES_AN_EVENT * files


def check_room(trial: DeviceTrial, events_per_s: float, seconds: float, hint: str) -> None:
    """InputError where the disk has no room for a trial of so many events a second; hint: what would need less."""
    require_room(trial.output.parent, needed_bytes(events_per_s, seconds, len(trial.outputs)), hint)


def plan_shown(trials: Sequence[Trial], parts: Sequence[tuple[str, str, str]], *, simulated: bool) -> Outcome:
    """What a dry run shows: its parts as (part, what, detail), and all files."""
    files = [("file", str(output), f"trial {trial.number}") for trial in trials for output in trial.outputs]
    rows = [dict(zip(("part", "what", "detail"), row, strict=True)) for row in (*parts, *files)]
    return Outcome(rows, simulated, {"files": len(files)}, made=False)


def wait_for_object(trial: Trial) -> None:
    """Ask for the object of the second and any later trial to be put in place."""
    if trial.number:
        console.wait_for_enter(f"trial {trial.number}: put the object in place, then press Enter")


def make_recipe(
    method: int,
    parameters: Mapping[str, Any],
    setup: Mapping[str, Any],
    sensor: Mapping[str, Any],
    more: Mapping[str, Any],
    *,
    parents: tuple[Header, ...],
    simulated: bool,
) -> Recipe:
    """What is known of a recording from devices beforehand; its content stands in for the rest.

    setup: what the devices are and how they are set; sensor: the recording's datasets, of which those of the sensor
    belong to its set-up; parameters, more: all else, in the order of the header.
    """
    known = {name: np.asarray(value).tolist() for name, value in sensor.items() if name.startswith("sensor/")}
    described = {**parameters, "setup": dict(setup), "sensor": without_nan(known), **more}
    return Recipe(OUTPUT, method, described, parents=parents, simulated_source=simulated)


def without_nan(value: Any) -> Any:
    """JSON has no NaN, which stands for a missing dot."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if value != value else value


@contextmanager
def signals_counted() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM are counted at first, so that a recording ends between slices; a second one breaks off."""
    signals: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return

    def count(number: int, frame: Any) -> None:
        signals.append(number)
        if len(signals) > 1:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, count) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def spread(values: "array[float]") -> Any:
    """Median, 99th percentile and most."""
    return np.percentile(np.frombuffer(values), [50, 99, 100])


def lost_datasets(counts: Mapping[str, int]) -> dict[str, Any]:
    """What devices lost, by DEVICE.REASON, as datasets of a recording."""
    return {LOST + reason: np.int64(count) for reason, count in counts.items()}


def lost_columns(datasets: Mapping[str, Any]) -> dict[str, Any]:
    """What was lost, as columns of the table: how many events, as far as that is known, and why; None for nothing."""
    counts = {name.removeprefix(LOST): int(count) for name, count in datasets.items() if name.startswith(LOST)}
    return {"lost": losses.events_lost(counts), "lost_why": losses.reasons(counts)}


def finish(writer: RecordingWriter, recipe: Recipe, datasets: Mapping[str, Any]) -> None:
    """Join the segments, with datasets that are known only now; whatever keeps it from that says where they are."""
    try:
        writer.finish(recipe, datasets, from_device=True)
    except BaseException as error:
        writer.leave()
        raise with_hint(error, writer) from None


def with_hint(error: BaseException, writer: RecordingWriter) -> BaseException:
    """An error for the user, or Ctrl-C, that says too what is left for `evetac repair`; any other as it is."""
    left = f"{writer.folder}, for `evetac repair`"
    if isinstance(error, EvetacError):
        error.kept = left
    if isinstance(error, KeyboardInterrupt):
        return KeyboardInterrupt(f"interrupted: what was recorded is in {left}")
    return error


def raise_end(
    error: Exception | None, ended: str, saved: str, result: Outcome | None, interrupted: str = INTERRUPTED
) -> None:
    """Let an error or Ctrl-C that ended the trial go on from here, with what was saved and the rows of its files.

    error: what failed; ended: why the recording ended, in words; interrupted: what is said on Ctrl-C.
    """
    if error is not None:
        failed = error if isinstance(error, EvetacError) else DeviceError(str(error))
        failed.kept = saved
        raise attach_outcome(failed, result)
    if ended == INTERRUPTED:
        raise attach_outcome(KeyboardInterrupt(f"{interrupted}: {saved}"), result)
