"""evaluate tracking: whether every dot ends where it began, and its distance from truth (paper, section V-C).

A trajectory that begins and ends with nothing on the gel is tracked successfully if all dots end within 20 px of their
start. This is the paper's end-point consistency, which needs no truth. For simulations, whose true dots are known, the
distance from truth is reported too. A simulated trajectory that ends with the gel still sheared
has no consistency. Tracks of the same recordings by several presets are compared row by row.

The preset `stable` puts lost dots back at rest, which would make its end points consistent by itself. So the columns
`..._before_reset` judge each dot also where it was in the slice before it was put back. A dot was put back in a slice
if its flag `lost` ends there, and it is then within a few px of its start. Other presets put nothing back.
"""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each, mean
from evetac_cli.evaluate.tracking import PAPER, EvaluateTracking
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

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows: Rows = []
        for path, name in zip(each(job.inputs, progress), names, strict=True):
            with StageFile(path, "tracks") as tracks, _truth(tracks, params.recordings) as truth:
                rows.append({"file": path.name, "preset": name, **_trajectory(tracks, truth)})
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
    return report(job, "evaluate tracking", METHOD, parameters, headers, measure, force=force)


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


def _trajectory(tracks: StageFile, truth: Recording | None) -> dict[str, Any]:
    """Return the row of a trajectory."""
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
        return row
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
    return row | {
        "error_px_rms": float(np.sqrt(squares.mean())),
        "error_px_worst": worst_px,
        "still_px_rms": float(np.sqrt(still_squares.mean())),
    }


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

    def rms(name: str) -> float | None:
        square = mean(row[name] ** 2 for row in with_truth)
        return None if square is None else math.sqrt(square)

    return {
        "error_px_rms": rms("error_px_rms"),
        "with_truth": len(with_truth),
        "error_px_worst": max((row["error_px_worst"] for row in with_truth), default=None),
        "still_px_rms": rms("still_px_rms"),
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


STAGE = Stage(jobs, run, for_people=for_people)
