"""evaluate data-rate: bytes a second of event recordings against an RGB sensor (paper, "Data Rate Experiments").

Three intervals: the whole recording; contact, from the first touch (0.03 N) to its loss; and so many seconds about the
onset of slip. When there is contact, only a simulation knows. The onset is the truth's first slice of slip after the
current begins to fall, and where there is no truth, that of the labels beside the recording. What cannot be answered is
said in words, and the whole is answered for any recording.

All events count, those in the window too. Every event has the same size, as the paper sends them.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.params import EvaluateDataRate, recipe_of
from evetac_cli.resources import table
from evetac_cli.stages.evaluate import Rows, picture, report, report_job
from evetac_cli.stages.label import ramp_start
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.provenance import Header
from evetac_cli.store.read import Recording, open_recording

INPUTS = ("recording", "labels")
OUTPUT = "report"
METHOD = 1
INTERVALS = ("whole", "contact", "slip")
TOUCH_N = 0.03  # normal force that is contact
SHOWN = 6  # time courses in the picture
SHOWN_MS = 10  # that one point of a time course is the mean of


class Interval(NamedTuple):
    """Slices [start, stop) of a recording, or why there is no such interval."""

    start: int
    stop: int
    why_not: str = ""


def jobs(files: list[Path], params: EvaluateDataRate, out: Path | None) -> list[Job]:
    """One report over all recordings."""
    _rgb_bytes_s(params)
    return report_job(files, "data-rate", out)


def run(job: Job, params: EvaluateDataRate, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every recording, one for every interval beside the paper's, and the time course as a picture."""
    parents: list[Header] = []
    for path in job.inputs:
        with open_recording(path) as recording:
            if len(recording) == 0:
                raise InputError("a recording without a single slice has no data rate", where=str(path))
            parents.append(recording.header)
            labels = None if recording.has("truth") else _labels_beside(recording)
            parents += [labels.header] if labels else []

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows: Rows = []
        for number, path in enumerate(job.inputs):
            with open_recording(path) as recording:
                rows.append(_row(recording, params))
            progress(number + 1, len(job.inputs))
        intervals = [_interval_row(interval, rows) for interval in INTERVALS]
        shares = {f"share_{row['interval']}": row["share_mean"] for row in intervals}
        rgb = {"rgb_bytes_s": _rgb_bytes_s(params)}
        return [*rows, *intervals], {"trajectories": len(rows), **shares, **rgb}

    outcome = report(job, "evaluate data-rate", METHOD, recipe_of(params), parents, measure, force=force)
    shown = min(len(job.inputs), SHOWN)
    return picture.beside(
        outcome, job.output, lambda figure: _draw(figure, job.inputs, params, outcome), (11.0, 0.8 + 2.2 * shown)
    )


def _rgb_bytes_s(params: EvaluateDataRate) -> float:
    """Bytes a second of the RGB sensor; InputError if its frame is none."""
    if not re.fullmatch("[1-9][0-9]{0,4}x[1-9][0-9]{0,4}x[1-9][0-9]?", params.rgb_frame):
        raise InputError(
            "not a frame",
            where="--rgb-frame",
            expected="width x height x bytes, as in 540x480x3",
            found=params.rgb_frame,
        )
    width, height, pixel = (int(size) for size in params.rgb_frame.split("x"))
    return width * height * pixel * params.rgb_hz


def _row(recording: Recording, params: EvaluateDataRate) -> dict[str, Any]:
    bytes_a_slice = np.diff(recording.starts) * params.event_bytes
    found = intervals(recording, params.around_s)
    row: dict[str, Any] = {
        "file": recording.path.name,
        "duration_s": len(recording) / 1000,
        "events": recording.event_count,
        "most_bytes_a_slice": int(bytes_a_slice.max()),
        "contact_from_ms": None if found["contact"].why_not else found["contact"].start,
        "contact_to_ms": None if found["contact"].why_not else found["contact"].stop,
        "slip_ms": None if found["slip"].why_not else (found["slip"].start + found["slip"].stop) // 2,
    }
    for name, interval in found.items():
        bytes_s = None
        if not interval.why_not:
            bytes_s = 1000 * float(bytes_a_slice[interval.start : interval.stop].mean())
        row[f"bytes_s_{name}"] = bytes_s
        row[f"share_{name}"] = None if bytes_s is None else bytes_s / _rgb_bytes_s(params)
    reasons = [f"{name}: {interval.why_not}" for name, interval in found.items() if interval.why_not]
    return row | {"not_answered": "; ".join(reasons) or None}


def intervals(recording: Recording, around_s: float) -> dict[str, Interval]:
    """Which slices are the whole, in contact, and about slip."""
    slices = len(recording)
    contact = Interval(0, 0, "no truth, and only a simulation knows when it touches")
    if recording.has("truth"):
        force_n = recording.read("truth/normal_force_n")
        touched, loaded = np.flatnonzero(force_n >= TOUCH_N), np.flatnonzero(force_n > 0)
        contact = Interval(0, 0, "nothing was touched")
        if len(touched):
            contact = Interval(int(touched[0]), int(loaded[-1]) + 1)
    return {"whole": Interval(0, slices), "contact": contact, "slip": _about_slip(recording, around_s)}


def _about_slip(recording: Recording, around_s: float) -> Interval:
    """As many slices before the onset as from it on; not answered where the recording does not hold them all."""
    half = round(500 * around_s)
    if recording.has("truth"):
        start = ramp_start(recording)
        slips = start + np.flatnonzero(recording.read("truth/slip")[start:])
        if not len(slips):
            return Interval(0, 0, "no slip")
        onset = int(slips[0])
    else:
        labels = _labels_beside(recording)
        if labels is None:
            return Interval(0, 0, "neither truth nor labels beside the recording")
        onset = labels.onset
        if onset < 0:
            return Interval(0, 0, "no slip in the labels")
    first, last = onset - half, onset + half
    if first < 0 or last > len(recording):
        held_s = (min(last, len(recording)) - max(first, 0)) / 1000
        return Interval(0, 0, f"{held_s:g} s of {around_s:g} s about the onset at {onset} ms are recorded")
    return Interval(first, last)


class _Labels(NamedTuple):
    header: Header
    onset: int


def _labels_beside(recording: Recording) -> _Labels | None:
    """The labels that lie beside a recording, if there are any; InputError if they are another recording's."""
    path = output_path(recording.path, "labels", None)
    if not path.exists():
        return None
    with StageFile(path, "labels") as labels:
        if recording.header["id"] not in labels.header["parents"]:
            raise InputError(
                "these labels belong to another recording",
                where=str(path),
                expected=f"made from {recording.path}",
                hint=f"evetac label --force {recording.path}",
            )
        return _Labels(labels.header, int(labels.read("onset_slice")))


def _interval_row(interval: str, rows: Rows) -> dict[str, Any]:
    """Mean and sd over the trajectories that have an answer, beside the paper's."""
    shares = [row[f"share_{interval}"] for row in rows if row[f"share_{interval}"] is not None]
    mean = float(np.mean(shares)) if shares else None
    paper_mean, paper_sd = table("paper")["data_rate"][interval]
    return {
        "interval": interval,
        "trajectories": len(shares),
        "share_mean": mean,
        "share_sd": float(np.std(shares, ddof=1)) if len(shares) > 1 else None,
        "paper_share_mean": paper_mean,
        "paper_share_sd": paper_sd,
        "paper_sds_off": None if mean is None else (mean - paper_mean) / paper_sd,
    }


def _draw(figure: Any, paths: tuple[Path, ...], params: EvaluateDataRate, outcome: Outcome) -> None:
    """Bytes a second over time, one panel a recording, up to SHOWN; the RGB sensor's as a line."""
    simulated = " (simulated)" if outcome.simulated else ""
    more = f", the first {SHOWN} of {len(paths)} recordings" if len(paths) > SHOWN else ""
    figure.suptitle(f"Data rate, mean over {SHOWN_MS} ms{more}{simulated}")
    shown = paths[:SHOWN]
    for axes, path in zip(figure.subplots(len(shown), 1, squeeze=False)[:, 0], shown, strict=True):
        with open_recording(path) as recording:
            bytes_a_slice = np.diff(recording.starts) * params.event_bytes
            found = intervals(recording, params.around_s)
        edges = np.arange(0, len(bytes_a_slice), SHOWN_MS)
        width = np.diff(np.append(edges, len(bytes_a_slice)))
        mb_s = np.add.reduceat(bytes_a_slice, edges) / width * 1e-3
        axes.step(edges / 1000, mb_s, where="post", linewidth=0.8, color=picture.CORRECT, label="events")
        axes.axhline(_rgb_bytes_s(params) * 1e-6, color="black", linestyle="--", linewidth=1, label="RGB sensor")
        for name, colour in (("contact", "0.6"), ("slip", picture.EARLY)):
            if not found[name].why_not:
                span = (found[name].start / 1000, found[name].stop / 1000)
                axes.axvspan(*span, color=colour, alpha=0.25, linewidth=0, label=name)
        top = 1.25 * max(float(mb_s.max()), _rgb_bytes_s(params) * 1e-6)  # leaves room for the legend
        axes.set(ylabel="MB/s", xlim=(0, len(bytes_a_slice) / 1000), ylim=(0, top))
        axes.set_title(path.name, fontsize=8)
        picture.quiet_grid(axes)
        axes.legend(fontsize=7, loc="upper left", ncols=4)
    axes.set_xlabel("time [s]")
