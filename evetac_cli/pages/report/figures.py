"""Headline figures of a study, shown at the top of the report, and those of two studies side by side."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.events import SLICES_PER_S
from evetac_cli.pages.report.study import LABELS_MS, TIMING_MS, Study, StudyTrial
from evetac_cli.pages.shared import figure_text


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
    counted = [trial for trial in slipping if not trial.doubt]
    errors = [trial.label_error_ms for trial in counted if trial.label_error_ms is not None]
    abstained = f" of {len(slipping)} trials that slip; labels abstain in {len(slipping) - len(counted)}"
    if counted:
        over = f"{len(counted)}{abstained}"
        right = sum(LABELS_MS[0] <= error <= LABELS_MS[1] for error in errors)
        figures += [
            StudyFigure("onsets with a label", len(errors) / len(counted), over, kind="share"),
            StudyFigure("labels within -4..+3 ms of the truth", right / len(counted), over, kind="share"),
        ]
    elif slipping:
        figures.append(StudyFigure("onsets with a label", 0, f"0{abstained}", kind="count"))
    if errors:
        figures.append(StudyFigure("t_c - t_s, median [ms]", float(np.median(errors)), f"{len(errors)}{abstained}"))
    for words, symbol, of_trials, left_out in (
        ("timing correct, all models", "t_c", [trial.late_by for trial in trials], sum(t.not_timed for t in trials)),
        ("timing correct by truth, all models", "t_s", [trial.late_by_truth for trial in trials], 0),
    ):
        judged = [ms for of_trial in of_trials for ms in of_trial]
        if not judged:
            continue
        more = f" of {len(judged) + left_out}" if left_out else ""
        why = f"; {left_out} left out: labels abstain or have no onset" if left_out else ""
        known_ms = [ms for ms in judged if ms is not None]
        correct = sum(TIMING_MS[0] <= ms <= TIMING_MS[1] for ms in known_ms)
        over = f"{len(judged)}{more} pairs of trial and model{why}"
        figures.append(StudyFigure(words, correct / len(judged), over, kind="share"))
        if known_ms:
            never = f"; {len(judged) - len(known_ms)} never detected" if len(judged) > len(known_ms) else ""
            over = f"{len(known_ms)}{more} pairs{never}{why}"
            figures.append(StudyFigure(f"t_m - {symbol}, median [ms]", float(np.median(known_ms)), over))
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


class Pairing(NamedTuple):
    """The trials of two studies that belong together, and in words how they were paired and what is left over."""

    pairs: list[tuple[StudyTrial, StudyTrial]]
    words: str


def _identity(trial: StudyTrial) -> tuple[Any, ...]:
    row = trial.row
    return row.scene, row.object, row.seed, row.trial


# What is the same in two trials of a pair, the strictest first. The sensor is what many studies compare.
SAME: tuple[tuple[str, Callable[[StudyTrial], tuple[Any, ...]]], ...] = (
    ("recipe", lambda trial: (trial.recording_id,)),
    ("scene, object, sensor name, seed and trial number", lambda trial: (*_identity(trial), trial.row.sensor)),
    ("scene, object, seed and trial number", _identity),
)


def matched(studies: Sequence[Study]) -> Pairing:
    """Pair the trials of two studies by what is the same in them, if that is one trial in each."""
    left = [list(study.trials) for study in studies]
    pairs: list[tuple[StudyTrial, StudyTrial]] = []
    words = []
    for what, key_of in SAME:
        one, other = (_unique(trials, key_of) for trials in left)
        new = [(trial, other[key]) for key, trial in one.items() if key in other]
        if new:
            words.append(f"{len(new)} by the same {what}")
            paired = {id(trial) for pair in new for trial in pair}
            left = [[trial for trial in trials if id(trial) not in paired] for trials in left]
        pairs += new
    unpaired = " and ".join(
        f"{len(trials)} of {len(study.trials)} of {study.name}" for trials, study in zip(left, studies, strict=True)
    )
    how = ", ".join(words) or f"none has the same {' or '.join(what for what, _ in SAME)}"
    return Pairing(pairs, f"{len(pairs)} pairs of trials: {how}. Without a partner: {unpaired}.")


def _unique(
    trials: Sequence[StudyTrial], key_of: Callable[[StudyTrial], tuple[Any, ...]]
) -> dict[tuple[Any, ...], StudyTrial]:
    """Return the trials whose key no other one has; a key of an unknown seed is none."""
    keys = [key_of(trial) for trial in trials]
    times = Counter(keys)
    return {
        key: trial
        for key, trial in zip(keys, trials, strict=True)
        if times[key] == 1 and (len(key) == 1 or trial.row.seed is not None)
    }
