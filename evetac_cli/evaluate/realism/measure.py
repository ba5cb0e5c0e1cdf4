"""evaluate realism: distance of a simulated recording from a real one, next to the distance between the real halves.

Two phases are compared if both recordings have them: the longest rest, and all slices with motion. Distances are
relative differences; for distributions they are the largest difference of the cumulative shares. The two halves of the
real recording show what to expect of identical cameras. As halves are shorter, their random differences are 1.4 times
as large. Dot edges are compared if both recordings show dots that were stroked from rest.

A classifier measures how well half-second windows of the two recordings can be distinguished: the area under its ROC
curve (AUC) on held-out windows, 0.5 if they are indistinguishable. For comparison there is the AUC between two
recordings of the real sensor (--same), or between alternate seconds of the real recording.
"""

import functools
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.realism import EvaluateRealism
from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.jobs import Job, Outcome, Progress, Rows, Stage, silent
from evetac_cli.kernels import realism
from evetac_cli.kernels.calibration import rest_image
from evetac_cli.kernels.identify.rest import check_still, find_hot
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.stages.identify import pressed
from evetac_cli.stages.identify.pressed import LONGEST_REST, SHORTEST_REST
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import Recording, open_recording

SHORTEST_MOTION = 300  # slices
MOST_EVENTS = 5_000_000  # limit per phase

Counts = NDArray[np.int64]
METHOD = 4
MOST_WINDOWS = 240  # per recording, for the classifier: two minutes
NEAR = 0.10  # distances up to this count as near in the summary
EDGES = ("dot_radius_px", "edge_sigma_px", "contrast_over_threshold")  # figures of the dots' edges
RELATIVE, CUMULATIVE, HELD_OUT = "relative difference", "largest gap of cumulative shares", "AUC of held-out windows"


@dataclass(frozen=True)
class ContactPhase:
    """The events of one phase on a continuous time axis without the gaps between its pieces, and events per slice."""

    events: Events
    counts: Counts

    @property
    def duration_us(self) -> int:
        """Duration of the phase."""
        return len(self.counts) * SLICE_US

    def part(self, first: int, stop: int) -> "ContactPhase":
        """Return the slices [first, stop) of the phase, with time starting at 0."""
        begin, end = (int(self.counts[:place].sum()) for place in (first, stop))
        events = self.events.part(begin, end)
        return ContactPhase(events._replace(t=events.t - first * SLICE_US), self.counts[first:stop])

    def halves(self) -> tuple["ContactPhase", "ContactPhase"]:
        """Return the first and the second half."""
        middle = len(self.counts) // 2
        return self.part(0, middle), self.part(middle, 2 * middle)


def rest_and_motion(recording: Recording) -> tuple[ContactPhase | None, ContactPhase | None]:
    """Return the longest rest and all motion of a recording; None for either if it is missing or too short."""
    counts = np.diff(recording.starts)
    spells = rest_image.quiet_spells(counts)
    first, stop = max(spells, key=lambda spell: spell[1] - spell[0], default=(0, 0))
    stop = min(stop, first + LONGEST_REST)
    rest = _phase(recording, [(first, stop)]) if stop - first >= SHORTEST_REST else None
    if rest is not None and not _is_still(rest, recording.frame_px):
        rest, spells = None, []  # something always moves: this is only the slowest motion
    edges = [0, *(edge for spell in spells for edge in spell), len(counts)]
    moving = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
    whole = sum(b - a for a, b in moving) >= SHORTEST_MOTION
    return rest, _phase(recording, moving) if whole else None


def stroked(recording: Recording, rest: ContactPhase | None) -> pressed.Press | None:
    """Return the dots that were stroked from rest and the estimates from them; None if no dots were stroked."""
    noise_hz = 0.0
    if rest is not None:
        noise_hz = realism.at_rest(*rest.events, recording.frame_px, rest.duration_us)["ordinary_hz"]
    with suppress(ValueError):
        return pressed.find(recording, one_sensor("evetac").log_contrast, None, noise_hz, np.random.default_rng(0))
    return None


def _is_still(phase: ContactPhase, frame_px: tuple[int, int]) -> bool:
    width, height = frame_px
    pixel = phase.events.y.astype(np.int64) * width + phase.events.x
    hot = find_hot(np.bincount(pixel, minlength=width * height), phase.duration_us * 1e-6)
    try:
        check_still(hot.reshape(height, width))
    except ValueError:
        return False
    return True


def _phase(recording: Recording, pieces: list[tuple[int, int]]) -> ContactPhase | None:
    """Return pieces of a recording joined end to end, up to MOST_EVENTS; None if the first slice already has more."""
    parts: list[Events] = []
    counts: list[Counts] = []
    slices, event_count = 0, 0
    for first, end in pieces:
        room = recording.starts[first] + MOST_EVENTS - event_count
        stop = min(end, int(np.searchsorted(recording.starts, room, side="right")) - 1)
        if stop <= first:
            break
        events = recording.between(first, stop)
        parts.append(events._replace(t=events.t + (slices - first) * SLICE_US))
        counts.append(np.diff(recording.starts[first : stop + 1]))
        slices += stop - first
        event_count += events.size
    return ContactPhase(concatenate(parts), np.concatenate(counts).astype(np.int64)) if parts else None


@dataclass(frozen=True)
class Side:
    """The compared parts of a recording: its phases and its pressed dots; None for missing parts."""

    name: str
    rest: ContactPhase | None
    motion: ContactPhase | None
    press: pressed.Press | None


def jobs(files: list[Path], params: EvaluateRealism, out: Path | None) -> list[Job]:
    """Return one report job over a real and a simulated recording, in this order."""
    if len(files) != 2:
        expected = "two recordings: the real one, then the simulated one"
        raise InputError("another number of files", expected=expected, found=f"{len(files)}")
    return report_job(files, "realism", out, *([params.same] if params.same else []))


def run(job: Job, params: EvaluateRealism, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per figure: real, simulated, their distance, and the distance of the real recording's halves."""
    headers, frame_px = _headers(job.inputs)

    @functools.cache
    def sides() -> tuple[Side, Side]:
        """Read both recordings, once and only if needed."""
        both = []
        for number, path in enumerate(job.inputs[:2]):
            with open_recording(path) as recording:
                rest, motion = rest_and_motion(recording)
                press = None if motion is None else stroked(recording, rest)
                both.append(Side(recording.path.name, rest, motion, press))
            progress(number + 1, len(job.inputs) + 2)
        return _as_long(both[0], both[1])

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows = compare(*sides(), frame_px)
        if not rows:
            where, expected = f"{job.inputs[0]}, {job.inputs[1]}", f"{SHORTEST_REST} ms at rest or {SHORTEST_MOTION} ms"
            raise InputError("no phase in common", where=where, expected=f"{expected} of motion, in both")
        compared, with_halves, as_halves = _counts(rows)
        apart = _separability(job.inputs, progress)
        beside = "auc_of_halves" if params.same is None else "auc_of_same"
        of_auc = {"auc": "distance", beside: "distance_of_halves", "windows": "real", "windows_simulated": "simulated"}
        return [*rows, *apart], {
            "figures": len(compared),
            "figures_unknown": len(rows) - len(compared),
            "figures_with_halves": with_halves,
            f"figures_within_{100 * NEAR:.0f}_percent": sum(row["distance"] <= NEAR for row in compared),
            "figures_as_near_as_halves": as_halves,
            **{name: apart[0][key] if apart else None for name, key in of_auc.items()},
        }

    outcome = report(job, "evaluate realism", METHOD, recipe_of(params), headers, measure, force=force)
    return picture.beside(outcome, job.output, lambda figure: _draw(figure, *sides(), frame_px), (11.0, 7.5))


def for_people(rows: Rows, params: EvaluateRealism) -> tuple[Rows, list[str]]:
    """Return all rows, the number of figures that are near, and how well a classifier distinguishes the recordings."""
    of_figures = [row for row in rows if row["measure"] != HELD_OUT]
    compared, with_halves, as_halves = _counts(of_figures)
    near = sum(row["distance"] <= NEAR for row in compared)
    lines = [
        f"{near} of {len(compared)} figures are within {NEAR:.0%} of the real recording's;"
        f" {as_halves} of {with_halves} differ no more than its own halves do."
    ]
    if unknown := len(of_figures) - len(compared):
        lines.append(f"{unknown} figures are left out, because a recording has too few events or the real value is 0.")
    if len(of_figures) == len(rows):
        lines.append("No AUC: a recording has too few windows of 0.5 s.")
    for row in rows:
        if row["measure"] == HELD_OUT:
            same = row["distance_of_halves"]
            beside = "" if same is None else f"; two recordings of the real sensor: {same:.2f}"
            windows = f"{row['real']:.0f} real and {row['simulated']:.0f} simulated windows"
            auc_words = f"an AUC of {row['distance']:.2f} (0.5: never, 1: always)"
            lines.append(f"{windows}: distinguished with {auc_words}{beside}.")
    return rows, lines


def _counts(rows: Rows) -> tuple[Rows, int, int]:
    """Return rows with a distance, how many of them have one between the halves, and how many differ no more."""
    compared = [row for row in rows if row["distance"] is not None]
    with_halves = [row for row in compared if row["distance_of_halves"] is not None]
    return compared, len(with_halves), sum(row["distance"] <= row["distance_of_halves"] for row in with_halves)


def _headers(paths: Sequence[Path]) -> tuple[list[Header], tuple[int, int]]:
    """Return headers and frame of the recordings; raise InputError if frames differ or a recording is given twice."""
    headers: list[Header] = []
    frames: list[tuple[int, int]] = []
    for path in paths:
        with open_recording(path) as recording:
            header, frame_px = recording.header, recording.frame_px
        if header["id"] in [other["id"] for other in headers]:
            raise InputError("a recording given twice", where=str(path), expected="different recordings")
        headers.append(header)
        frames.append(frame_px)
        if frame_px != frames[0]:
            expected, found = ("{} x {} px".format(*frame) for frame in (frames[0], frame_px))
            raise InputError("different frames", where=str(path), expected=expected, found=found)
    return headers, frames[0]


def _separability(paths: Sequence[Path], progress: Progress) -> Rows:
    """Return the row of the classifier: windows of each recording, AUC, and AUC for one sensor.

    No row if the recordings are too short.
    """
    sides = []
    for number, path in enumerate(paths):
        with open_recording(path) as recording:
            sides.append(window_features(recording))
        progress(number + 3, len(paths) + 2)
    real, simulated, *others = sides
    of_two = auc(real, simulated)
    if of_two is None:
        return []
    of_one = auc(real, others[0]) if others else auc_of_halves(real)
    counts = float(len(real)), float(len(simulated))
    unknown = float("nan") if of_one is None else of_one
    return [_row("windows of 0.5 s", "classifier, windows", *counts, of_two, unknown, HELD_OUT)]


def window_features(recording: Recording) -> Floats:
    """Return features (windows, features) of consecutive half seconds, with slices at rest and in motion separate."""
    counts = np.diff(recording.starts)
    at_rest = np.zeros(len(counts), np.bool_)
    for first, stop in rest_image.quiet_spells(counts):
        at_rest[first:stop] = True
    length = realism.WINDOW_SLICES
    whole = min(len(counts) // length, MOST_WINDOWS) * length
    rows = [
        realism.features(block.events, block.starts, at_rest[block.first : block.stop], recording.frame_px)
        for block in recording.blocks(length, stop=whole)
    ]
    return np.array(rows, np.float64).reshape(-1, len(realism.FEATURES))


def auc(first: Floats, second: Floats) -> float | None:
    """Return the AUC of held-out windows of two recordings; None if they are too short."""
    try:
        return realism.separability(first, second)
    except ValueError:
        return None


def auc_of_halves(of: Floats) -> float | None:
    """Return the AUC between alternate pairs of windows of one recording; None if it is too short."""
    other = np.arange(len(of)) // realism.BLOCK % 2 == 1
    return auc(of[~other], of[other])


def _as_long(real: Side, simulated: Side) -> tuple[Side, Side]:
    """Shorten the rests to equal length, because the number of hot pixels and the observed intervals depend on it."""
    if real.rest is None or simulated.rest is None:
        return real, simulated
    slices = min(len(real.rest.counts), len(simulated.rest.counts))
    first, second = (replace(side, rest=side.rest.part(0, slices)) for side in (real, simulated) if side.rest)
    return first, second


def compare(real: Side, simulated: Side, frame_px: tuple[int, int]) -> Rows:
    """Return a row per figure of the phases that both recordings have."""
    rows: Rows = []
    if real.rest and simulated.rest:
        rows += _phase_rows("rest", real.rest, simulated.rest, frame_px, _at_rest)
    if real.motion and simulated.motion:
        rows += _phase_rows("motion", real.motion, simulated.motion, frame_px, _in_motion)
    if real.press and simulated.press:
        rows += _edge_rows(real.press, simulated.press)
    return rows


def _at_rest(phase: ContactPhase, frame_px: tuple[int, int]) -> tuple[dict[str, float], dict[str, NDArray]]:
    events = phase.events
    scalars = realism.at_rest(*events, frame_px, phase.duration_us)
    hot, ordinary, _ = realism.split_hot(*events, frame_px, phase.duration_us * 1e-6)
    return scalars, {
        "events_a_slice, distribution": phase.counts,
        "hot_interval_us, distribution": realism.times_between(hot)[0],
        "ordinary_interval_us, distribution": realism.times_between(ordinary)[0],
    }


def _in_motion(phase: ContactPhase, frame_px: tuple[int, int]) -> tuple[dict[str, float], dict[str, NDArray]]:
    return realism.in_motion(*phase.events, frame_px, phase.counts), {"events_a_slice, distribution": phase.counts}


def _phase_rows(
    name: str,
    real: ContactPhase,
    simulated: ContactPhase,
    frame_px: tuple[int, int],
    measure: Callable[[ContactPhase, tuple[int, int]], tuple[dict[str, float], dict[str, NDArray]]],
) -> Rows:
    halves = [measure(half, frame_px) for half in real.halves()]
    (scalars, samples), (other_scalars, other_samples) = (measure(phase, frame_px) for phase in (real, simulated))
    rows = [
        _row(name, figure, scalars[figure], other_scalars[figure], _relative(scalars[figure], other_scalars[figure]),
             _relative(halves[0][0][figure], halves[1][0][figure]), RELATIVE)
        for figure in scalars
    ]  # fmt: skip
    for figure, sample in samples.items():
        ours, theirs = (float(np.median(one)) if len(one) else float("nan") for one in (sample, other_samples[figure]))
        of_halves = realism.largest_gap(halves[0][1][figure], halves[1][1][figure])
        gap = realism.largest_gap(sample, other_samples[figure])
        rows.append(_row(name, figure, ours, theirs, gap, of_halves, CUMULATIVE))
    return rows


def _edge_rows(real: pressed.Press, simulated: pressed.Press) -> Rows:
    """Return rows for radius and blur of the dots' edges, and for events from dot to gel.

    Half the confidence interval replaces the distance of the halves.
    """
    rows = []
    for figure in EDGES:
        ours, theirs = (getattr(side.optics, figure) for side in (real, simulated))
        own = (ours.high - ours.low) / 2 / ours.value
        rows.append(
            _row("dot edges", figure, ours.value, theirs.value, _relative(ours.value, theirs.value), own, RELATIVE)
        )
    return rows


def _row(
    phase: str, figure: str, real: float, simulated: float, distance: float, of_halves: float, measure: str
) -> dict[str, Any]:
    values = {"real": real, "simulated": simulated, "distance": distance, "distance_of_halves": of_halves}
    finite = {key: float(value) if np.isfinite(value) else None for key, value in values.items()}
    return {"phase": phase, "figure": figure, **finite, "measure": measure}


def _relative(first: float, second: float) -> float:
    """Return the difference relative to the first value; NaN if either is unknown or the first is 0."""
    return abs(second / first - 1.0) if first and np.isfinite(first) and np.isfinite(second) else float("nan")


def _draw(figure: Any, real: Side, simulated: Side, frame_px: tuple[int, int]) -> None:
    """Plot times between events of hot pixels, pixel rates, the spectrum of the event rate, and the dots' edges."""
    figure.suptitle(f"Real: {real.name}\nSimulated: {simulated.name}")
    panels = picture.panels(figure, 4, 2)
    for side, colour, label in ((real, "black", "real"), (simulated, picture.CORRECT, "simulated")):
        style = {"color": colour, "label": label}
        if side.rest:
            seconds = side.rest.duration_us * 1e-6
            hot, _, _ = realism.split_hot(*side.rest.events, frame_px, seconds)
            for polarity, line in ((None, "-"), (1, "--"), (0, ":")):
                line_style = {**style, "label": f"{label}{'' if polarity is None else (', OFF', ', ON')[polarity]}"}
                _cumulative(panels[0], realism.times_between(hot, polarity)[0], linestyle=line, **line_style)
            pixel = side.rest.events.y.astype(np.int64) * frame_px[0] + side.rest.events.x
            busiest = np.sort(np.bincount(pixel))[::-1] / seconds
            if busiest.any():
                panels[1].plot(1 + np.arange(np.count_nonzero(busiest)), busiest[busiest > 0], **style)
        phase = side.motion or side.rest
        if phase:
            frequency_hz, power = realism.spectrum(phase.counts)
            if power.any():
                panels[2].plot(frequency_hz, power, **style)
        if side.press:
            rims = side.press.profile
            panels[3].plot(rims.distance_px, rims.share, **style)
    panels[0].set(xlabel="time between events of a hot pixel [us]", ylabel="share of shorter or equal times")
    panels[1].set(xlabel="rank of the pixel (1: most events)", ylabel="rate of the pixel [events/s]")
    panels[2].set(xlabel="frequency [Hz]", ylabel="power of events per slice [events\u00b2/Hz]")
    panels[3].set(xlabel="distance from the dot's edge [px]", ylabel="share of darkening events", xlim=(-8, 8))
    missing = ("no hot pixel at rest", "no rest", "nothing moves", "no dots were stroked")
    for axes, words, logarithmic in zip(panels, missing, ("x", "xy", "xy", ""), strict=True):
        if not axes.lines:
            picture.say_instead(axes, words)
            continue
        for letter in logarithmic:
            picture.log_axis(getattr(axes, f"{letter}axis"))
    picture.legend(figure, panels)


def _cumulative(axes: Any, values: NDArray, **style: Any) -> None:
    """Plot the cumulative share of values, in at most a thousand steps."""
    if len(values):
        shares = np.linspace(0.0, 1.0, min(1000, len(values)))
        axes.plot(np.quantile(values, shares), shares, **style)


STAGE = Stage(jobs, run, for_people=for_people)
