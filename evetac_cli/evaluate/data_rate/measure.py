"""evaluate data-rate: bytes per second of events against those of an RGB sensor (paper, "Data Rate Experiments").

There are three intervals:

- the whole recording;
- contact, from the first touch (0.03 N) to its loss; known only in simulations;
- a given number of seconds around the onset of slip. The onset is the first slice of gross slip in the truth after the
  current begins to fall; without truth it is the onset in the labels next to the recording.

Each interval has a row over all recordings, and with several objects one for each.

If an interval is unknown, the column `not_measured` gives the reason. The whole recording is always known.

Only events in columns x < 540 are counted, as in the paper, which compares them with a frame of 540 columns. Events in
the columns beyond, where a cut gel has its window, are reported as a separate share. Every event has the same size, as
in the paper.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each, mean, sd
from evetac_cli.evaluate.data_rate import COLUMNS, PAPER, SCENE, EvaluateDataRate
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.kernels.slip.covariates import TOUCH_N
from evetac_cli.stages.related_files import check_made_from, object_name
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.layout.ancestry import scene_words
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings import slip_grid
from evetac_cli.store.recordings.onset import LabelledOnset, gel_counts, in_short, labelled_onset
from evetac_cli.store.recordings.read import Recording, open_recording, true_onset

METHOD = 5
EVENT_BYTES = 5  # x, y and polarity
RGB_BYTES_S = 540 * 480 * 3 * 25  # of the paper's RGB sensor: frames of three bytes per pixel, 25 times per second
INTERVALS = ("whole", "contact", "slip")
ALL = "all"  # in the column `object` of a row over all recordings


class SliceInterval(NamedTuple):
    """Slices [start, stop) of a recording, or the reason why the interval is missing."""

    start: int
    stop: int
    missing_because: str = ""


Intervals = dict[str, SliceInterval]


def jobs(files: list[Path], params: EvaluateDataRate, out: Path | None) -> list[Job]:
    """Return one report job over all recordings."""
    return report_job(files, "data-rate", out)


def run(job: Job, params: EvaluateDataRate, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per recording and a row per interval with the paper's figures."""
    parents: list[Header] = []
    for path in job.inputs:
        with open_recording(path) as recording:
            if len(recording) == 0:
                raise InputError("the recording has no slices, so it has no data rate", where=str(path))
            parents.append(recording.header)
            labels = None if recording.has("truth/slip") else labels_beside(recording)
            parents += [labels.header] if labels else []

    as_papers = all(_as_the_papers(header) for header in parents)
    parameters = recipe_of(params) | ({} if as_papers else {"beside_the_paper": False})

    def measure() -> tuple[Rows, dict[str, Any]]:
        trials: list[tuple[Row, Intervals]] = []
        for path in each(job.inputs, progress):
            with open_recording(path) as recording:
                spans = intervals(recording, params.around_s)
                trials.append((_row(recording, spans), spans))
        rows = [row for row, _ in trials]
        of_intervals = [_interval_row(interval, trials, as_papers=as_papers) for interval in INTERVALS]
        objects = list(dict.fromkeys(row["object"] for row in rows))
        by_object = [
            _interval_row(interval, [one for one in trials if one[0]["object"] == name], as_papers, called=name)
            for name in objects
            for interval in INTERVALS
            if len(objects) > 1
        ]
        shares = {f"share_{row['interval']}": row["share_mean"] for row in of_intervals}
        shares |= {f"trajectories_{row['interval']}": row["trajectories"] for row in of_intervals}
        shares |= {f"window_share_{row['interval']}": row["window_share_mean"] for row in of_intervals}
        rgb = {"columns": COLUMNS, "rgb_bytes_s": RGB_BYTES_S}
        return [*rows, *of_intervals, *by_object], {"trajectories": len(rows), **shares, **rgb}

    return report(job, "evaluate data-rate", METHOD, parameters, parents, measure, force=force)


def for_people(rows: Rows, params: EvaluateDataRate) -> tuple[Rows, list[str]]:
    """Return all rows, and sentences with the mean share of the RGB sensor's bytes."""
    of_intervals = [row for row in rows if "interval" in row and row["object"] == ALL]
    lines = [
        f"{row['interval']}: {_share_in_words(row)}; n = {row['trajectories']} of"
        f" {row['trajectories'] + row['left_out']} recordings"
        + (f", left out: {row['left_out_because']}." if row["left_out"] else ".")
        for row in of_intervals
    ]
    if all(row["paper_share_mean"] is None for row in of_intervals):
        lines.append(
            f"The paper's figures are not shown: they apply to the motions of `evetac record --scene {SCENE}`."
        )
    return rows, lines + slip_grid.resting_on(rows)


def _share_in_words(row: Row) -> str:
    if row["share_mean"] is None:
        return "unknown"
    return (
        f"{row['share_mean']:.1%} of the RGB sensor's bytes per second in {row['columns']} columns,"
        f" plus {row['window_share_mean']:.1%} in the columns beyond (the window of a cut gel)"
    )


def _row(recording: Recording, spans: Intervals) -> dict[str, Any]:
    bytes_a_slice = gel_counts(recording, columns=COLUMNS) * EVENT_BYTES
    of_window = np.diff(recording.starts) * EVENT_BYTES - bytes_a_slice
    row: dict[str, Any] = {
        "file": recording.path.name,
        "object": object_name(recording.header),
        "duration_s": len(recording) / SLICES_PER_S,
        "events": recording.event_count,
        "events_of_window": int(of_window.sum()) // EVENT_BYTES,
        "max_bytes_per_slice": int(bytes_a_slice.max()),
        "contact_from_ms": None if spans["contact"].missing_because else spans["contact"].start,
        "contact_to_ms": None if spans["contact"].missing_because else spans["contact"].stop,
        "slip_ms": None if spans["slip"].missing_because else (spans["slip"].start + spans["slip"].stop) // 2,
    }
    for name, interval in spans.items():
        bytes_s, window_bytes_s = (
            None if interval.missing_because else SLICES_PER_S * float(counted[interval.start : interval.stop].mean())
            for counted in (bytes_a_slice, of_window)
        )
        row[f"bytes_s_{name}"] = bytes_s
        row[f"share_{name}"] = None if bytes_s is None else bytes_s / RGB_BYTES_S
        row[f"window_share_{name}"] = None if window_bytes_s is None else window_bytes_s / RGB_BYTES_S
    reasons = [f"{name}: {interval.missing_because}" for name, interval in spans.items() if interval.missing_because]
    return row | {slip_grid.COLUMN: slip_grid.nodes_of(recording), "not_measured": "; ".join(reasons) or None}


def intervals(recording: Recording, around_s: float) -> Intervals:
    """Return the slices of the whole recording, of contact, and of `around_s` around the onset of slip."""
    slices = len(recording)
    contact = SliceInterval(0, 0, "no truth; contact is known only in simulations")
    if recording.has("truth/normal_force_n"):
        force_n = recording.read("truth/normal_force_n")
        touched, loaded = np.flatnonzero(force_n >= TOUCH_N), np.flatnonzero(force_n > 0)
        contact = SliceInterval(0, 0, "nothing was touched")
        if len(touched):
            contact = SliceInterval(int(touched[0]), int(loaded[-1]) + 1)
    return {"whole": SliceInterval(0, slices), "contact": contact, "slip": _about_slip(recording, around_s)}


def _about_slip(recording: Recording, around_s: float) -> SliceInterval:
    """Return equally many slices before and after the onset; missing unless all of them were recorded."""
    half = round(500 * around_s)
    onset, why = slip_onset(recording)
    if onset is None:
        return SliceInterval(0, 0, why)
    first, last = onset - half, onset + half
    if first < 0 or last > len(recording):
        held_s = (min(last, len(recording)) - max(first, 0)) / SLICES_PER_S
        of_all = f"{held_s:g} s of {around_s:g} s around the onset at {onset} ms are recorded"
        return SliceInterval(0, 0, f"too little around the onset: {of_all}")
    return SliceInterval(first, last)


def slip_onset(recording: Recording) -> tuple[int | None, str]:
    """Return the onset of slip, by truth or by labels next to the recording; else None and why it is unknown."""
    if recording.has("truth/slip"):
        return true_onset(recording), "no slip"
    labels = labels_beside(recording)
    if labels is None:
        return None, "neither truth nor labels next to the recording"
    if labels.onset.abstained:
        return None, f"the labels abstain: {labels.onset.doubt}"
    return labels.onset.slice_, "no slip in the labels"


class _Labels(NamedTuple):
    header: Header
    onset: LabelledOnset


def labels_beside(recording: Recording) -> _Labels | None:
    """Return the labels next to a recording, or None; raise InputError if they belong to another recording."""
    path = output_path(recording.path, "labels", None)
    if not path.exists():
        return None
    with StageFile(path, "labels") as labels:
        check_made_from(labels, recording)
        return _Labels(labels.header, labelled_onset(labels))


def headers_beside(recording: Recording) -> list[Header]:
    """Return headers of a recording and of the files next to it.

    Raise InputError if these belong to another recording.
    """
    labels = None if recording.has("truth/slip") else labels_beside(recording)
    with dot_places(recording) as dots:
        tracks = dots[0] if dots is not None and dots[0] is not recording else None
        return [recording.header, *([labels.header] if labels else []), *([tracks.header] if tracks else [])]


@contextmanager
def dot_places(recording: Recording) -> Iterator[tuple[StageFile, str] | None]:
    """Yield the file and dataset of the dot positions of a recording: its truth, or the tracks next to it, or None.

    Raises InputError if the tracks belong to another recording.
    """
    if recording.has("truth"):
        yield recording, "truth/dot_xy_px"
        return
    path = output_path(recording.path, "tracks", None)
    if not path.exists():
        yield None
        return
    with StageFile(path, "tracks") as tracks:
        check_made_from(tracks, recording)
        yield tracks, "dot_xy_px"


def _as_the_papers(header: Header) -> bool:
    """Whether the simulated recordings behind a file are all of the paper's scene.

    Real recordings count as such: only the person who recorded them knows the motions.
    """
    recordings = [header, *header["history"].values()]
    names = [scene_words(one["parameters"], "name") for one in recordings if one["kind"] == "recording"]
    return all(name == SCENE for name in names if name is not None)


def _interval_row(
    interval: str, trials: Sequence[tuple[Row, Intervals]], as_papers: bool, called: str = ALL
) -> dict[str, Any]:
    """Return mean and standard deviation of the share of the RGB sensor's bytes over the trajectories that have it.

    The others are `left_out`. `called`: the object of these trajectories, or ALL. The row has the paper's figures only
    if the motions are like the paper's.
    """
    shares = [row[f"share_{interval}"] for row, _ in trials if row[f"share_{interval}"] is not None]
    share_mean = mean(shares)
    whys = [spans[interval].missing_because for _, spans in trials if spans[interval].missing_because]
    paper_mean = PAPER.value("data rate", interval) if as_papers else None
    paper_sd = PAPER.value("data rate, sd", interval) if as_papers else None
    off = None
    if share_mean is not None and paper_mean is not None and paper_sd is not None:
        off = (share_mean - paper_mean) / paper_sd
    return {
        "interval": interval,
        "object": called,
        "trajectories": len(shares),
        "left_out": len(whys),
        "left_out_because": in_short(whys) or None,
        "share_mean": share_mean,
        "share_sd": sd(shares),
        "window_share_mean": mean(row[f"window_share_{interval}"] for row, _ in trials),
        "columns": COLUMNS,
        "paper_share_mean": paper_mean,
        "paper_share_sd": paper_sd,
        "deviation_from_paper_sds": off,
    }


STAGE = Stage(jobs, run, for_people=for_people)
