"""evaluate vibration: the frequency at which the gel vibrates, in whole recordings and in windows of several lengths.

If the tone is known, from a simulation's truth or from `--true-hz`, windows with the correct frequency are counted,
next to the paper's table ("Sensing Vibrations"). Recordings are read in pieces, so memory does not grow with length.

The true tone only decides which slices are examined (those in which it sounds) and which result is correct.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.vibration import PAPER, WINDOWS_S, EvaluateVibration
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.jobs import Job, Outcome, Progress, Rows, Stage, silent
from evetac_cli.kernels import vibration
from evetac_cli.store.recordings.read import Recording, open_recording

METHOD = 4
SHORTEST_MS, LONGEST_MS = 100, 10_000  # of a window: shorter ones have no spectrum, longer ones need too much memory
READ_MS = 250  # events read at once
ENOUGH_WINDOWS = 5  # to estimate the tone's uncertainty from their differences
PANELS = 10  # of the plot
STRONGEST = 3  # frequencies of a window's spectrum among which the paper always finds the tone
TONE = "truth/tone_hz"


class Survey(NamedTuple):
    """Spectra and frequencies of one recording; frequencies in Hz, None for no vibration."""

    seconds: float
    whole: vibration.Spectrum  # summed over windows of the longest length
    counts: NDArray[np.int64]  # events per bin of 1 / rate
    motion: dict[int, list[float | None]]  # window length in ms -> a frequency per window, by motion
    paper: dict[int, list[float | None]]  # the same by the paper's method
    strongest: dict[int, list[list[float]]]  # window length in ms -> the strongest frequencies of each window


def jobs(files: list[Path], params: EvaluateVibration, out: Path | None) -> list[Job]:
    """Return one report job over all recordings."""
    return report_job(files, "vibration", out)


def run(job: Job, params: EvaluateVibration, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per recording and method, then one per window length; plot the spectra next to the report.

    The plot has a panel for the first recording of each tone, and for those with an unknown tone. `motion_ratio_*` is
    the gel's motion at a harmonic over that at the tone. The paper's method always returns a frequency, even without
    vibration.
    """
    windows_ms = _windows_ms(params.windows)
    if params.lowest_hz >= params.rate / 2:
        expected = f"below half of --rate, {params.rate / 2:g} Hz"
        raise InputError("no frequencies remain", where="--lowest-hz", expected=expected, found=f"{params.lowest_hz:g}")
    headers = []
    for path in job.inputs:
        with open_recording(path) as recording:
            _span(recording, params)
            headers.append(recording.header)
    spectra: list[tuple[str, Survey]] = []
    drawn_hz: list[float | None] = []

    def measure() -> tuple[Rows, dict[str, Any]]:
        first: Rows = []
        second: Rows = []
        for number, path in enumerate(job.inputs):
            with open_recording(path) as recording:
                start, stop, expected_hz = _span(recording, params)

                def advance(done: int, number: int = number, of: int = stop - start) -> None:
                    progress(number * of + done, len(job.inputs) * of)

                survey = _survey(recording, start, stop, windows_ms, params, advance)
            if len(spectra) < PANELS and (expected_hz is None or expected_hz not in drawn_hz):
                spectra.append((path.name, survey))
                drawn_hz.append(expected_hz)
            for method in ("default", "paper") if params.preset == "default" else ("paper",):
                first.append({"file": path.name, "method": method, **_whole(survey, method, expected_hz, params)})
                for row in _by_window(survey, method, expected_hz, params):
                    second.append({"file": path.name, "method": method, **row})
        return [*first, *second], _summary(first, second)

    outcome = report(job, "evaluate vibration", METHOD, recipe_of(params), headers, measure, force=force)
    if not outcome.made:  # spectra are not stored in rows: plot them only when measured
        return outcome

    def draw(figure: Any) -> None:
        _draw(figure, spectra, params, simulated=outcome.simulated)

    return picture.beside(outcome, job.output, draw, (9.0, 1.4 + 1.9 * len(spectra)))


def for_people(rows: Rows, params: EvaluateVibration) -> tuple[Rows, list[str]]:
    """Return all rows, the number of recordings in which each method finds the tone, and which are too short."""
    lines = []
    whole = [row for row in rows if "seconds" in row]
    for method in dict.fromkeys(row["method"] for row in whole):
        of_method = [row for row in whole if row["method"] == method]
        with_tone = [row for row in of_method if row["correct"] is not None]
        vibrating = sum(row["frequency_hz"] is not None for row in of_method)
        right = (
            f"; correct, within {params.tolerance_hz:g} Hz of the tone, in {sum(row['correct'] for row in with_tone)}"
        )
        tones = f"{right} of {len(with_tone)} with a known tone" if with_tone else ""
        lines.append(f"{method}: a vibration in {vibrating} of {len(of_method)} recordings{tones}.")
    recordings = len({row["file"] for row in whole})
    for length in _windows_ms(params.windows):
        count = len({row["file"] for row in rows if row.get("window_s") == length / 1000})
        if count < recordings:
            short = f"{recordings - count} of {recordings} recordings are left out, because they are shorter"
            lines.append(f"Windows of {length / 1000:g} s: {short}.")
    return rows, lines


def _windows_ms(text: str) -> list[int]:
    """Return the window lengths in ms, longest first."""
    try:
        lengths = [1000 * float(part) for part in text.split(",")]
    except ValueError:
        lengths = []
    if not lengths or not all(SHORTEST_MS <= length <= LONGEST_MS for length in lengths):
        expected = f"seconds from {SHORTEST_MS / 1000:g} to {LONGEST_MS / 1000:g}, such as 10,2,1"
        raise InputError("not a list of window lengths", where="--windows", expected=expected, found=text)
    return sorted({round(length) for length in lengths}, reverse=True)


def _span(recording: Recording, params: EvaluateVibration) -> tuple[int, int, float | None]:
    """Return slices [start, stop) to examine, and the true tone in Hz or None.

    In simulations the slices are those in which the tone sounds.
    """
    start, stop, expected_hz = 0, len(recording), params.true_hz
    if recording.has(TONE):
        tone_hz = recording.read(TONE)
        sounding = np.flatnonzero(tone_hz > 0.0)
        if len(sounding):
            # Truth is for the end of a slice: in the last slice the tone still sounds at first.
            start, stop = int(sounding[0]), min(int(sounding[-1]) + 2, stop)
            if len(np.unique(tone_hz[sounding])) > 1:
                raise InputError("more than one tone", where=str(recording.path), expected="one tone per recording")
            expected_hz = float(tone_hz[start]) if expected_hz is None else expected_hz
    if stop - start < SHORTEST_MS:
        where, expected = str(recording.path), f"{SHORTEST_MS} ms or more"
        raise InputError("too short to find a frequency", where=where, expected=expected, found=f"{stop - start} ms")
    return start, stop, expected_hz


def _survey(
    recording: Recording, start: int, stop: int, windows_ms: list[int], params: EvaluateVibration, advance: Any
) -> Survey:
    """Apply both methods to the slices [start, stop), in pieces of the longest window."""
    piece_ms = min(windows_ms[0], stop - start)
    lengths = [length for length in windows_ms if length <= piece_ms]
    motion: dict[int, list[float | None]] = {length: [] for length in lengths}
    by_counts: dict[int, list[float | None]] = {length: [] for length in lengths}
    strongest: dict[int, list[list[float]]] = {length: [] for length in lengths}
    whole: vibration.Spectrum | None = None
    all_counts = []
    fine_hz = max(params.rate, vibration.FINEST_HZ)
    with_motion = params.preset == "default"
    for first in range(start, stop, piece_ms):
        last = min(first + piece_ms, stop)
        tally, counts = _read(recording, first, last, fine_hz, params.rate, advance_from=start, advance=advance)
        all_counts.append(counts)
        if last - first == piece_ms:
            piece = vibration.spectrum(tally, fine_hz)
            whole = piece if whole is None else whole.plus(piece)
        for length in lengths:
            for begin in range(0, last - first - length + 1, length):
                counted = _part(counts, begin, length, params.rate)
                by_counts[length].append(_paper_tone_hz(counted, params))
                strongest[length].append(_strongest_hz(counted, params))
                if with_motion and length == piece_ms:
                    motion[length].append(_tone_hz(piece, params))
                elif with_motion:
                    window = vibration.spectrum(_part(tally, begin, length, fine_hz), fine_hz)
                    motion[length].append(_tone_hz(window, params))
    assert whole is not None  # the first piece has full length
    return Survey((stop - start) / SLICES_PER_S, whole, np.concatenate(all_counts), motion, by_counts, strongest)


def _read(
    recording: Recording, first: int, last: int, fine_hz: int, rate_hz: int, *, advance_from: int, advance: Any
) -> tuple[vibration.Tally, NDArray[np.int64]]:
    """Return signed events (cells, bins at `fine_hz`) and events (bins at `rate_hz`) of the slices [first, last)."""
    across, down = vibration.cell_grid(recording.frame_px)
    tally = np.zeros((across * down, (last - first) * fine_hz // SLICES_PER_S), np.int16)
    bins = (last - first) * rate_hz // SLICES_PER_S
    counts = np.zeros(bins, np.int64)
    for begin, _, events in recording.blocks(READ_MS, first, last):
        vibration.add_events(tally, *events, first * SLICE_US, fine_hz, across)
        places = (events.t - first * SLICE_US) * rate_hz // 1_000_000
        counts += np.bincount(places[places < bins], minlength=bins)
        advance(begin - advance_from)
    return tally, counts


def _part(values: NDArray, begin_ms: int, length_ms: int, rate_hz: int) -> NDArray:
    """Return the window of `length_ms` starting at `begin_ms`, along the last axis."""
    begin = begin_ms * rate_hz // SLICES_PER_S
    return values[..., begin : begin + length_ms * rate_hz // SLICES_PER_S]


def _tone_hz(spectrum: vibration.Spectrum, params: EvaluateVibration) -> float | None:
    tone = vibration.find(spectrum, params.lowest_hz, params.rate / 2, params.false_alarms).tone
    return None if tone is None else tone.frequency_hz


def _paper_tone_hz(counts: NDArray[np.int64], params: EvaluateVibration) -> float | None:
    return vibration.strongest_of_counts(counts, params.rate, params.lowest_hz)


def _strongest_hz(counts: NDArray[np.int64], params: EvaluateVibration) -> list[float]:
    """Return the strongest frequencies of a window, in Hz: the largest amplitudes of the paper's spectrum."""
    amplitude = np.abs(np.fft.rfft(counts - counts.mean()))
    frequency_hz = np.arange(len(amplitude)) * params.rate / len(counts)
    amplitude[frequency_hz < params.lowest_hz] = 0.0
    places = np.argsort(amplitude)[: -STRONGEST - 1 : -1]
    return [float(frequency_hz[place]) for place in places if amplitude[place] > 0.0]


def _whole(survey: Survey, method: str, expected_hz: float | None, params: EvaluateVibration) -> dict[str, Any]:
    """Return the row of a recording."""
    finding = vibration.Finding(None, {}, None)
    if method == "paper":
        frequency_hz = _paper_tone_hz(survey.counts, params)
    else:
        finding = vibration.find(survey.whole, params.lowest_hz, params.rate / 2, params.false_alarms)
        frequency_hz = finding.tone.frequency_hz if finding.tone else None
    return {
        "seconds": survey.seconds,
        "frequency_hz": frequency_hz,
        "uncertainty_hz": _uncertainty_hz(survey, finding.tone) if finding.tone else None,
        "motion_ratio_half_tone": finding.harmonics.get(0.5),
        "motion_ratio_double_tone": finding.harmonics.get(2.0),
        "motion_ratio_triple_tone": finding.harmonics.get(3.0),
        "line_above_band_hz": finding.above_band.frequency_hz if finding.above_band else None,
        "expected_hz": expected_hz,
        "correct": None if expected_hz is None else _near(frequency_hz, expected_hz, params.tolerance_hz),
    }


def _uncertainty_hz(survey: Survey, tone: vibration.SpectralLine) -> float:
    """Return one standard deviation of a tone: from noise, or from the spread of the shortest windows, if larger.

    The phase of the gel's response drifts with the tone's harmonics, which the noise estimate does not include.
    """
    windows = survey.motion[min(survey.motion)] if survey.motion else []
    near = [hz for hz in windows if hz is not None and abs(hz - tone.frequency_hz) < 0.1 * tone.frequency_hz]
    if len(near) < ENOUGH_WINDOWS:
        return tone.uncertainty_hz
    return max(tone.uncertainty_hz, float(np.std(near, ddof=1)) / math.sqrt(len(near)))


def _near(frequency_hz: float | None, expected_hz: float, tolerance_hz: float) -> bool:
    return frequency_hz is not None and abs(frequency_hz - expected_hz) <= tolerance_hz


def _by_window(
    survey: Survey, method: str, expected_hz: float | None, params: EvaluateVibration
) -> Iterator[dict[str, Any]]:
    """Yield a row per window length: correct windows, frequencies of the others, the paper's share.

    Twice the tone may alias to its half (400 Hz at a rate of 1000 Hz): such a window counts as both.
    """
    for length, frequencies in (survey.paper if method == "paper" else survey.motion).items():
        detected = [frequency_hz for frequency_hz in frequencies if frequency_hz is not None]
        row: dict[str, Any] = {
            "window_s": length / 1000,
            "windows": len(frequencies),
            "frequency_hz": float(np.median(detected)) if detected else None,
            "windows_without_vibration": len(frequencies) - len(detected),
        }
        if expected_hz is not None:
            tolerance_hz = max(params.tolerance_hz, 500.0 / length)  # half the frequency spacing of a window
            right = sum(_near(frequency_hz, expected_hz, tolerance_hz) for frequency_hz in frequencies)
            among_three = sum(
                any(_near(frequency_hz, expected_hz, tolerance_hz) for frequency_hz in of_window)
                for of_window in survey.strongest[length]
            )
            doubles_hz = (2 * expected_hz, abs((2 * expected_hz + params.rate / 2) % params.rate - params.rate / 2))
            wrong = [frequency_hz for frequency_hz in detected if not _near(frequency_hz, expected_hz, tolerance_hz)]
            half = [_near(frequency_hz, expected_hz / 2, tolerance_hz) for frequency_hz in wrong]
            double = [any(_near(frequency_hz, place, tolerance_hz) for place in doubles_hz) for frequency_hz in wrong]
            row |= {
                "expected_hz": expected_hz,
                "tolerance_hz": tolerance_hz,
                "correct": right,
                "share": right / len(frequencies),
                "paper_share": PAPER.value("vibration", f"{expected_hz:g}", length / 1000),
                "among_three": among_three if method == "paper" else None,
                "among_three_share": among_three / len(frequencies) if method == "paper" else None,
                "windows_at_half_tone": sum(half),
                "windows_at_double_tone": sum(double),
                "windows_at_other_frequency": len(wrong) - sum(a or b for a, b in zip(half, double, strict=True)),
            }
        yield row


def _summary(first: Rows, second: Rows) -> dict[str, Any]:
    """Return the number of vibrating recordings, and the share of correct windows over all tones, with the paper's.

    A share is over the windows of recordings with a known tone that are long enough.
    """
    summary: dict[str, Any] = {
        "recordings": len({row["file"] for row in first}),
        "recordings_with_tone": len({row["file"] for row in first if row["expected_hz"] is not None}),
        "vibrating": sum(row["frequency_hz"] is not None for row in first if row["method"] == first[0]["method"]),
    }
    with_tone = [row for row in second if "correct" in row]
    for method in dict.fromkeys(row["method"] for row in with_tone):
        for window_s in dict.fromkeys(row["window_s"] for row in with_tone):
            rows = [row for row in with_tone if (row["method"], row["window_s"]) == (method, window_s)]
            if rows:
                windows = sum(row["windows"] for row in rows)
                summary[f"{method}_share_{window_s:g}_s"] = sum(row["correct"] for row in rows) / windows
                summary[f"{method}_windows_{window_s:g}_s"] = windows
                summary[f"{method}_recordings_{window_s:g}_s"] = len(rows)
    if with_tone:
        summary |= {f"published_share_{length:g}_s": PAPER.value("vibration", "all", length) for length in WINDOWS_S}
    return summary


def _draw(figure: Any, spectra: list[tuple[str, Survey]], params: EvaluateVibration, *, simulated: bool) -> None:
    """Plot spectra of motion and of events per slice, a panel per recording."""
    panels = picture.panels(figure, len(spectra), 1, sharex=True)
    for axes, (name, survey) in zip(panels, spectra, strict=True):
        amplitude = np.abs(np.fft.rfft(survey.counts - survey.counts.mean()))
        places_hz = np.arange(len(amplitude)) * params.rate / len(survey.counts)
        _draw_line(axes, places_hz, amplitude, params, "number of events (the paper's method)")
        frequency_hz = survey.whole.frequency_hz
        motion = np.sqrt(survey.whole.speed) / np.maximum(frequency_hz, params.lowest_hz)
        _draw_line(axes, frequency_hz, motion, params, "motion of the gel (default method)")
        axes.set(title=name, xlim=(0.0, params.rate / 2), ylim=(0.0, 1.05))
    panels[-1].set_xlabel("frequency [Hz]")
    figure.supylabel("amplitude relative to the largest", fontsize=9)
    figure.suptitle("Spectra of whole recordings" + (" (simulated)" if simulated else ""))
    picture.legend(figure, panels)


def _draw_line(axes: Any, frequency_hz: Floats, amplitude: Floats, params: EvaluateVibration, label: str) -> None:
    """Plot one spectrum relative to its largest amplitude in the band."""
    shown = (frequency_hz >= params.lowest_hz) & (frequency_hz <= params.rate / 2)
    highest = amplitude[shown].max(initial=0.0)
    if highest > 0.0:
        axes.plot(frequency_hz[shown], amplitude[shown] / highest, label=label, linewidth=0.9)


STAGE = Stage(jobs, run, for_people=for_people)
