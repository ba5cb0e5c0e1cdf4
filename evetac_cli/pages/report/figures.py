"""Headline figures of a study, shown at the top of the report, and those of two studies side by side."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.evaluate.labels import EARLIEST_MS, LATEST_MS
from evetac_cli.events import SLICES_PER_S
from evetac_cli.kernels.slip import metrics
from evetac_cli.pages.report.study import Study, StudyTrial
from evetac_cli.pages.report.tables import figure_text

TIMING_MS = (metrics.EARLIEST_MS, metrics.LATEST_MS)
LABELS_MS = (EARLIEST_MS, LATEST_MS)


class StudyFigure(NamedTuple):
    """One figure of a study: name, value, number of trials behind it, and kind of number.

    kind: `share`, 0 to 1; `time` in s; `count`; otherwise empty, and the unit is in the name.
    """

    name: str
    value: float | int
    over: str = ""
    kind: str = ""


def in_words(value: float | int, kind: str) -> str:
    """Return a figure as text: shares in percent, times and large counts in a suitable unit."""
    size = abs(value)
    if kind == "share":
        return f"{value:.0%}"
    if kind == "time":
        for unit, seconds in (("h", 3600), ("min", 60)):
            if size >= 2 * seconds:
                return f"{value / seconds:.3g} {unit}"
        return f"{value:.3g} s"
    if kind == "count":
        for name, many in (("billion", 1e9), ("million", 1e6)):
            if size >= many:
                return f"{value / many:.3g} {name}"
    return figure_text(value)


def headline(study: Study) -> list[StudyFigure]:
    """Return the figures over all trials together; figures that no trial provides are left out."""
    trials = study.trials
    seconds = [trial.row.slices / SLICES_PER_S for trial in trials if trial.row.slices]
    figures = [
        StudyFigure("trials", len(trials)),
        StudyFigure("recorded", sum(seconds), kind="time"),
        StudyFigure("events", sum(trial.events or 0 for trial in trials), kind="count"),
        StudyFigure("objects", len({trial.row.object for trial in trials if trial.row.object is not None})),
        StudyFigure("sensors", len({trial.row.sensor for trial in trials if trial.row.sensor is not None})),
    ]
    slipping = [trial for trial in trials if trial.t_s is not None and trial.labelled_by is not None]
    errors = [trial.label_error_ms for trial in slipping if trial.label_error_ms is not None]
    if slipping:
        over = f"{len(slipping)} trials that slip"
        right = sum(LABELS_MS[0] <= error <= LABELS_MS[1] for error in errors)
        figures += [
            StudyFigure("onsets with a label", len(errors) / len(slipping), over, kind="share"),
            StudyFigure("labels within -4..+3 ms of the truth", right / len(slipping), over, kind="share"),
        ]
    if errors:
        figures.append(StudyFigure("t_c - t_s, median [ms]", float(np.median(errors)), str(len(errors))))
    judged = [ms for trial in trials for ms in trial.late_by]
    if judged:
        over = f"{len(judged)} pairs of trial and model"
        known_ms = [ms for ms in judged if ms is not None]
        correct = sum(TIMING_MS[0] <= ms <= TIMING_MS[1] for ms in known_ms)
        figures.append(StudyFigure("timing correct, all models", correct / len(judged), over, kind="share"))
        figures += (
            [StudyFigure("t_m - t_c, median [ms]", float(np.median(known_ms)), str(len(known_ms)))] if known_ms else []
        )
    figures += [
        StudyFigure("F1 of the best model", report.summary[key])
        for report in study.reports("evaluate slip")
        for key in ("f1", "best_f1")
        if report.summary.get(key) is not None
    ][:1]
    dots = [trial.tracking_px for trial in trials if trial.tracking_px is not None]
    if dots:
        rms = float(np.sqrt(np.mean(np.square(dots))))
        figures.append(StudyFigure("dots from the truth, rms [px]", rms, str(len(dots))))
    grasps = [trial.grasp for trial in trials if trial.grasp is not None]
    if grasps:
        held_grasps = [grasp for grasp in grasps if grasp.get("balanced")]
        figures.append(
            StudyFigure("grasps lifted and kept", len(held_grasps) / len(grasps), str(len(grasps)), kind="share")
        )
        for name, key in (("object moved, median [mm]", "moved_mm"), ("grip at the end, median [N]", "force_end_n")):
            values = [grasp[key] for grasp in held_grasps if isinstance(grasp.get(key), (int, float))]
            figures += [StudyFigure(name, float(np.median(values)), f"{len(values)} kept")] if values else []
    return figures


def matched(studies: Sequence[Study]) -> list[tuple[StudyTrial, StudyTrial]]:
    """Return the trials in both studies, matched by recipe, else by scene, object, sensor, seed and trial number."""
    one, other = (study.trials for study in studies)
    by_id = {trial.recording_id: trial for trial in other}
    by_name = {_identity(trial): trial for trial in other if trial.row.seed is not None}
    pairs = []
    for trial in one:
        match = by_id.get(trial.recording_id) or by_name.get(_identity(trial))
        if match is not None:
            pairs.append((trial, match))
    return pairs


def _identity(trial: StudyTrial) -> tuple[Any, ...]:
    row = trial.row
    return row.scene, row.object, row.sensor, row.seed, row.trial
