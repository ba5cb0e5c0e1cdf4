"""Gather what view shows of a trial, no larger for an hour than for a second."""

import numpy as np

from evetac_cli.inspect.view.lines import lanes_of, model_output, onsets_of, panels_of
from evetac_cli.inspect.view.pictures import choose_frame_times, draw_pictures, frame_of, place_dots, window_of
from evetac_cli.inspect.view.trial_files import Trial
from evetac_cli.inspect.view.view_data import ViewData
from evetac_cli.jobs import Progress
from evetac_cli.params import View


def collect_view(trial: Trial, params: View, span: tuple[int, int], progress: Progress) -> ViewData:
    """Gather what is shown of the slices [start, stop)."""
    empty = span[0] == span[1]
    probability = model_output(trial, span)
    found = ViewData(
        slices=trial.slices,
        span=span,
        shown_ms=params.shown_ms,
        simulated=any(file.header["simulated"] for file in trial.files),
        frame_px=frame_of(trial),
        window_px=window_of(trial),
        onsets={} if empty else onsets_of(trial, span, probability),
        panels=[] if empty else panels_of(trial, span, probability),
        lanes=[] if empty else lanes_of(trial, span, probability),
        notes=_copied(trial) + trial.notes,
        frame_times=np.empty(0, np.int64),
        dense={},
        pictures=[],
        events=[],
        rest_xy_px=None,
        dot_xy_px=None,
        lost=None,
        true_xy_px=None,
    )
    if not empty and (trial.recording is not None or trial.tracks is not None):
        choose_frame_times(found, trial, params.images)
        draw_pictures(found, trial, progress)
        place_dots(found, trial)
    return found


def _copied(trial: Trial) -> list[str]:
    """A word on labels that no sensor could have given."""
    copied = trial.labels is not None and trial.labels.header["parameters"].get("method") == "truth"
    return ["The labels were copied from the truth (simulated)."] if copied else []
