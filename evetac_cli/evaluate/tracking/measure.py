"""evaluate tracking: whether every dot ends where it began, and its distance from truth (paper, section V-C).

A trajectory that begins and ends with nothing on the gel is tracked successfully if all dots end within 20 px of their
start. This is the paper's end-point consistency, which needs no truth. For simulations, whose true dots are known, the
distance from truth is reported too, and plotted over time. A simulated trajectory that ends with the gel still sheared
has no consistency. Tracks of the same recordings by several presets are compared row by row.

The preset `stable` puts lost dots back at rest, which would make its end points consistent by itself. So the columns
`..._before_reset` judge each dot also where it was in the slice before it was put back. A dot was put back in a slice
if its flag `lost` ends there, and it is then within a few px of its start. Other presets put nothing back.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each, mean
from evetac_cli.evaluate.common.source import Source
from evetac_cli.evaluate.tracking import EvaluateTracking
from evetac_cli.evaluate.tracking.paper import PAPER
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.stages import row_blocks
from evetac_cli.stages.related_files import OTHER_FOLDER, Origins, check_made_from
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings import slip_grid
from evetac_cli.store.recordings.read import Recording, open_recording

METHOD = 8
DOTS, TRUE_DOTS = "dot_xy_px", "truth/dot_xy_px"
CONSISTENT_PX = 20.0  # as in the paper
ROUNDING_PX = 0.1  # margin for positions stored as float32
BIN_MS = 20  # of the plot's time axis
LEAST_PX = 1e-3  # smallest error in the plot


def jobs(files: list[Path], params: EvaluateTracking, out: Path | None) -> list[Job]:
    """Return one report job over all tracks files."""
    return report_job(files, "tracking", out)


def run(job: Job, params: EvaluateTracking, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per preset, then one per trajectory; lengths in px over all dots and slices.

    dots_lost: dots that end more than 20 px from their start; for a preset the mean over the trajectories with lost
    dots, as in the paper. `events_per_dot` is a mean over dots and slices. `still_px_rms` is the error of a tracker
    that never moves dots, for comparison.
    """
    headers = []
    truth_count = 0
    for path in job.inputs:
        with StageFile(path, "tracks") as tracks:
            if not tracks.length(DOTS):
                raise InputError("the tracks have no slices", where=str(path))
            _check_preset(path, tracks.header["parameters"])
            with _truth(tracks, params.recordings) as truth:
                truth_count += truth is not None
            headers.append(tracks.header)
    names = _preset_names([header["parameters"] for header in headers])
    over_time: dict[str, list[Floats]] = {}

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows: Rows = []
        for path, name in zip(each(job.inputs, progress), names, strict=True):
            with StageFile(path, "tracks") as tracks, _truth(tracks, params.recordings) as truth:
                row, squares = _trajectory(tracks, truth)
            rows.append({"file": path.name, "preset": name, **row})
            over_time.setdefault(name, []).extend([squares] if squares is not None else [])
        presets = [_preset(name, [row for row in rows if row["preset"] == name]) for name in dict.fromkeys(names)]
        summary = {
            "trajectories": len(rows),
            "with_truth": truth_count,
            **_lengths(rows),
            "decided": sum(row["consistent"] is not None for row in rows),
            "dots_lost": sum(row["dots_lost"] or 0 for row in rows),
        }
        return [*presets, *rows], summary

    # A report that has the truth of more or fewer recordings is a different report.
    parameters = {**recipe_of(params), "with_truth": truth_count}
    outcome = report(job, "evaluate tracking", METHOD, parameters, headers, measure, force=force)
    if not outcome.made:  # errors over time are not stored in rows: plot them only when measured
        return outcome

    def draw(figure: Any) -> None:
        _draw(figure, outcome.rows, over_time, Source.of(headers))

    return picture.beside(outcome, job.output, draw, (6.2 * sum(_panels(outcome.rows, over_time)), 4.2))


def for_people(rows: Rows, params: EvaluateTracking) -> tuple[Rows, list[str]]:
    """Return all rows, and for each preset how often every dot ended where it began."""
    lines = []
    for row in rows:
        if "file" in row:
            continue
        left = row["trajectories"] - row["decided"]
        of_all = f"{left} of {row['trajectories']} trajectories"
        sheared = f"; {of_all} are left out, because they end with the gel sheared" * bool(left)
        if not row["decided"]:
            lines.append(f"{row['preset']}: unknown whether dots end at their start{sheared}.")
        else:
            published = row["paper_consistent_share"]
            beside = "" if published is None else f" (paper, on its own recordings: {published:.0%})"
            reset = row["dots_put_back"]
            before = f"; {row['consistent_before_reset']} without the {reset} times a lost dot was put back" * bool(
                reset
            )
            lines.append(
                f"{row['preset']}: all dots end within {CONSISTENT_PX:g} px of their start in"
                f" {row['consistent']} of {row['decided']}{beside}{before}{sheared}."
            )
    return rows, lines + slip_grid.resting_on(rows)


@contextmanager
def _truth(tracks: StageFile, folder: Path | None) -> Iterator[Recording | None]:
    """Yield the recording with the true dots; None if it is not found, or has no truth.

    Raises InputError if it is a different recording, or if it is missing in the given folder.
    """
    origins = Origins("recording", folder)
    path = origins.find(tracks) if folder is None else origins.must_find(tracks, OTHER_FOLDER)
    if path is None:
        yield None
        return
    with open_recording(path) as recording:
        check_made_from(tracks, recording)
        if not recording.has("truth"):
            yield None
            return
        true, dots = (file.contents()[name][1][1] for file, name in ((recording, TRUE_DOTS), (tracks, DOTS)))
        if true != dots:
            expected = f"{true} dots, like the truth in {path}"
            raise InputError("another number of dots", where=str(tracks.path), expected=expected, found=str(dots))
        yield recording


def _check_preset(path: Path, parameters: dict[str, Any]) -> None:
    """Raise InputError unless the parameters of tracks name the preset by which they are compared."""
    if not isinstance(parameters.get("preset"), str) or ("constants" not in parameters and "camera" not in parameters):
        raise InputError("no preset in the header", where=str(path), expected="tracks of `evetac track`")


def _preset_names(parameters: list[dict[str, Any]]) -> list[str]:
    """Return the preset of every file; several sets of manually changed constants are numbered."""
    variants: dict[str, list[str]] = {}
    names = []
    for entry in parameters:
        same = variants.setdefault(entry["preset"], [])
        made_by = entry["constants"] if "constants" in entry else entry["camera"]  # from track, or from track --rgb
        constants = json.dumps(made_by, sort_keys=True)
        if constants not in same:
            same.append(constants)
        number = same.index(constants) + 1
        names.append(entry["preset"] if number == 1 else f"{entry['preset']}, {number}")
    return names


def _trajectory(tracks: StageFile, truth: Recording | None) -> tuple[dict[str, Any], Floats | None]:
    """Return the row of a trajectory, and the mean squared error of its dots over time, if truth is known."""
    rest = tracks.read("sensor/dot_xy_px").reshape(-1, 2)
    present = np.isfinite(rest).all(axis=1)
    rest, slices = rest[present], tracks.length(DOTS)
    end_px = np.linalg.norm(tracks.read(DOTS, slices - 1)[0, present] - rest, axis=1)
    put_back, before_px = _before_reset(tracks, rest, present)
    farthest_px = np.maximum(end_px, before_px)
    row: dict[str, Any] = {
        "consistent": bool((end_px <= CONSISTENT_PX).all()),
        "dots_lost": int((end_px > CONSISTENT_PX).sum()),
        "consistent_before_reset": bool((farthest_px <= CONSISTENT_PX).all()),
        "dots_lost_before_reset": int((farthest_px > CONSISTENT_PX).sum()),
        "dots_put_back": put_back,
        "dots_flagged_lost": int(tracks.read("lost", slices - 1).sum()),
        "end_distance_px_worst": float(end_px.max()),
        "events_per_dot": _mean_events(tracks, present),
        "error_px_rms": None,
        "error_px_worst": None,
        "still_px_rms": None,
        slip_grid.COLUMN: None if truth is None else slip_grid.nodes_of(truth),
    }
    if truth is None:
        return row, None
    still_px = np.linalg.norm(rest - truth.read(TRUE_DOTS, slices - 1)[0, present], axis=1)
    if (still_px > CONSISTENT_PX).any():
        row |= dict.fromkeys(("consistent", "dots_lost", "consistent_before_reset", "dots_lost_before_reset"))
    squares, still_squares, worst_px = np.empty(slices), np.empty(slices), 0.0
    for first, stop in row_blocks(slices):
        true = truth.read(TRUE_DOTS, first, stop)[:, present]
        error = np.linalg.norm(tracks.read(DOTS, first, stop)[:, present] - true, axis=2).astype(np.float64)
        still = np.linalg.norm(rest - true, axis=2).astype(np.float64)
        squares[first:stop] = np.mean(error**2, axis=1)
        still_squares[first:stop] = np.mean(still**2, axis=1)
        worst_px = max(worst_px, float(error.max()))
    row |= {
        "error_px_rms": float(np.sqrt(squares.mean())),
        "error_px_worst": worst_px,
        "still_px_rms": float(np.sqrt(still_squares.mean())),
    }
    edges = np.arange(0, slices, BIN_MS)
    return row, np.add.reduceat(squares, edges) / np.diff(np.append(edges, slices))


def _before_reset(tracks: StageFile, rest: Floats, present: NDArray[np.bool_]) -> tuple[int, Floats]:
    """Return how often dots were put back, and each dot's largest distance from its start just before that, 0 if never.

    Only slices in which a flag `lost` ends are looked at, so most files cost one pass over the flags.
    """
    from evetac_cli.kernels.tracking.lost_dots import AT_REST_PX  # imports numba

    farthest_px, put_back = np.zeros(len(rest)), 0
    last = np.zeros(len(rest), bool)
    for first, stop in row_blocks(tracks.length(DOTS)):
        lost = tracks.read("lost", first, stop)[:, present] != 0
        ended = np.concatenate([last[None], lost[:-1]]) & ~lost
        last = lost[-1]
        for slice_ in map(int, first + np.flatnonzero(ended.any(axis=1))):
            before, after = np.linalg.norm(tracks.read(DOTS, slice_ - 1, slice_ + 1)[:, present] - rest, axis=2)
            back = ended[slice_ - first] & (after <= AT_REST_PX + ROUNDING_PX)
            put_back += int(back.sum())
            farthest_px[back] = np.maximum(farthest_px[back], before[back])
    return put_back, farthest_px


def _mean_events(tracks: StageFile, present: NDArray[np.bool_]) -> float:
    """Return events per dot and slice, over the dots that exist."""
    slices = tracks.length(DOTS)
    blocks = (tracks.read("events_per_dot", first, stop) for first, stop in row_blocks(slices))
    return float(sum(int(block[:, present].sum(dtype=np.int64)) for block in blocks) / (slices * present.sum()))


def _lengths(rows: Rows) -> dict[str, Any]:
    """Return errors over trajectories with equal weights; None without truth."""
    with_truth = [row for row in rows if row["error_px_rms"] is not None]
    if not with_truth:
        return {"error_px_rms": None, "with_truth": 0, "error_px_worst": None, "still_px_rms": None}
    return {
        "error_px_rms": float(np.sqrt(np.mean([row["error_px_rms"] ** 2 for row in with_truth]))),
        "with_truth": len(with_truth),
        "error_px_worst": max(row["error_px_worst"] for row in with_truth),
        "still_px_rms": float(np.sqrt(np.mean([row["still_px_rms"] ** 2 for row in with_truth]))),
    }


def _preset(name: str, rows: Rows) -> dict[str, Any]:
    """Return the row of a preset, with the paper's figures where it has them."""
    decided = [row for row in rows if row["consistent"] is not None]

    def ends(when: str, *papers: Row) -> Row:
        """Return how many trajectories are consistent, and the dots lost in the others."""
        lost = [row[f"dots_lost{when}"] for row in decided if not row[f"consistent{when}"]]
        consistent = len(decided) - len(lost) if decided else None
        of_paper = papers or ({}, {})
        return {
            f"consistent{when}": consistent,
            f"consistent{when}_share": None if consistent is None else consistent / len(decided),
            **of_paper[0],
            f"dots_lost{when}_counted": len(lost),
            f"dots_lost{when}_mean": mean(lost),
            **of_paper[1],
        }

    of_paper = (("paper_consistent_share", "consistent"), ("paper_dots_lost_mean", "dots lost"))
    return {
        "preset": name,
        "trajectories": len(rows),
        "decided": len(decided),
        **ends("", *({column: PAPER.value(quantity, name)} for column, quantity in of_paper)),
        **ends("_before_reset"),
        "dots_put_back": sum(row["dots_put_back"] for row in rows),
        "events_per_dot": mean(row["events_per_dot"] for row in rows),
        **_lengths(rows),
    }


def _draw(figure: Any, rows: Rows, over_time: dict[str, list[Floats]], source: Source) -> None:
    """Plot error over time by preset where truth is known, and the shares of consistent trajectories, if any."""
    with_truth, decided = _panels(rows, over_time)
    figure.suptitle("Dots tracked" + (" (simulated)" if source.simulated else ""))
    panels = list(figure.subplots(1, with_truth + decided, squeeze=False)[0])
    if with_truth:
        for number, (name, errors) in enumerate(over_time.items()):
            if errors:
                _draw_errors(panels[0], errors, name, picture.COLOURS[number % len(picture.COLOURS)])
        panels[0].set(xlabel="time [s]", ylabel="distance from the true dots, rms [px]")
        picture.log_axis(panels[0].yaxis)
    if decided:
        _draw_consistent(panels[-1], rows, source)
    picture.legend(figure, panels)


def _panels(rows: Rows, over_time: dict[str, list[Floats]]) -> tuple[bool, bool]:
    """Return which panels there are: errors over time, consistent shares."""
    return any(over_time.values()), any(row.get("consistent_share") is not None for row in rows)


def _draw_errors(axes: Any, errors: list[Floats], name: str, colour: str) -> None:
    """Plot the error over all trajectories, which may differ in length, and the range of most of them."""
    padded = np.full((len(errors), max(map(len, errors))), np.nan)
    for line, squares in zip(padded, errors, strict=True):
        line[: len(squares)] = squares
    seconds = (np.arange(padded.shape[1]) + 0.5) * BIN_MS * 1e-3
    lowest = LEAST_PX**2  # an error of 0 has no position on a logarithmic axis
    label = f"{name}, n = {len(errors)}"
    axes.plot(seconds, np.sqrt(np.maximum(np.nanmean(padded, axis=0), lowest)), color=colour, label=label)
    if len(errors) > 1:
        low, high = np.sqrt(np.maximum(np.nanpercentile(padded, (10, 90), axis=0), lowest))
        axes.fill_between(seconds, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.set_title("bands: 10 to 90 % of the trajectories")


def _draw_consistent(axes: Any, rows: Rows, source: Source) -> None:
    """Plot the consistent share of each preset with its interval by number of trajectories, and the paper's."""
    presets = [row for row in rows if "file" not in row]
    for place, row in enumerate(presets):
        if count := row["decided"]:
            share, colour = row["consistent_share"], picture.COLOURS[place % len(picture.COLOURS)]
            label = "95 % interval by the number of trajectories (Wilson)"
            axes.errorbar(share, place, xerr=picture.wilson(share, count), label=label, **picture.INTERVAL)
            axes.plot(share, place, "o", color=colour, markersize=8)
        if beside := PAPER.beside("paper_consistent_share", row, source):
            axes.plot(beside.value, place - 0.2, **picture.of_paper(beside.mark))
    picture.share_axis(axes.xaxis)
    axes.set(xlabel=f"share of trajectories that end within {CONSISTENT_PX:g} px", ylim=(len(presets) - 0.5, -0.5))
    axes.set_yticks(
        range(len(presets)),
        [f"{picture.plain(row['preset'])}\nn = {row['decided']} of {row['trajectories']}" for row in presets],
    )


STAGE = Stage(jobs, run, for_people=for_people)
