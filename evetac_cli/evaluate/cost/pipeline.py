"""The part `pipeline`: effect of the settings of a recording on the results of the whole chain, and their run time.

Every setting records the same seeded slip trials and grasps, and derives everything from them as the commands do:
labels, tracks, features, the probabilities of the pretrained detector. All are compared with the truth of a reference:
the same trials, simulated more finely in every respect. Columns, as means over the trials:

- error_ms_gross_slip: onset of gross slip (`truth/slip`) in the simulation with this setting.
- error_ms_label: onset of the labels, against the onset of gross slip in the reference's truth.
- error_share_detection: share of trials in which the first detection by the pretrained detector (trained to warn 10 ms
  ahead) moves by more than DETECTION_MS from that on the reference.
- detection_moved_ms_median: the median of this shift. A mean would be dominated by single trials that shift by hundreds
  of ms near the threshold.
- error_px_dots: tracked dots against the reference's true dots, root mean square up to gross slip.
- error_n_shear: shear force on a pad, estimated from the tracked dots by a regression fitted at the defaults on other
  trials, against the reference's true force, root mean square up to gross slip.
- error_share_lost, error_mm_moved: grasps whose object was not held to the end, and the absolute difference of the
  object's motion in the gripper from the reference.
- time_us_*: processor time of the chain per recorded millisecond, over the trials. record_us_median, grasp_us_median:
  of recording alone, and per simulated millisecond of the grasp.

A second table has the paired difference of every setting from the defaults, with its interval (see paired). If it is
undecided, the table also has the command that would decide it and its minutes (see deciding). A third table has every
trial with its onsets. A row is on the Pareto front of an error if the intervals show this against every other row; the
reference is excluded. Every row contains the errors of labels, tracker and regression; the effect of a setting is in
the differences.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.commands.evaluate import EvaluateCost
from evetac_cli.evaluate import picture
from evetac_cli.evaluate.cost.chain import (
    BALANCE_S,
    LIFT_S,
    SLIP_ERRORS,
    Chain,
    ChainTrial,
    Lifted,
    detection_moved_ms,
    fit_force,
    run_chain,
    run_grasp,
    slip_errors,
)
from evetac_cli.evaluate.cost.deciding import Effort
from evetac_cli.evaluate.paired import difference, finite_or_none, on_front, share_difference
from evetac_cli.evaluate.rows import Extent, SolverSetting, line, run_times
from evetac_cli.jobs import Progress, Row, Rows

TRIALS = Extent(quick=4, full=20)
OBJECTS = (8, 1, 12, 4, 16, 3, 14, 6, 10, 17)  # these slip; used in turn
GRASPED = (11, 17, 12, 13, 10, 18)  # used in turn
CALIBRATION = (
    ChainTrial(8, 9000, 11),
    ChainTrial(3, 9001, 11),
)  # for the force regression; seeds not used in the reported trials

DEFAULTS = SolverSetting("defaults")
REFERENCE = SolverSetting("reference", solver={"step_ms": 0.125, "node_pitch_mm": 0.625, "camera_substeps": 4})
FINEST = SolverSetting("reference", solver={"step_ms": 0.05, "node_pitch_mm": 0.5, "camera_substeps": 8})
CHOICES = Extent[tuple[SolverSetting, ...]](
    quick=(
        *line("fixed step", "step_ms", (1.0,), "ms"),
        *line("tolerance", "tolerance_um", (0.05,), "um"),
        *line("node pitch", "node_pitch_mm", (1.25,), "mm"),
        *line("scans", "scans_per_ms", (2,), "a ms"),
    ),
    full=(
        *line("fixed step", "step_ms", (1.0, 0.5, 0.25, 0.125), "ms"),
        *line("tolerance", "tolerance_um", (5.0, 2.0, 1.0, 0.5, 0.1, 0.05), "um"),
        *line("theta", "theta", (1.0, 0.75, 0.5)),
        *line("node pitch", "node_pitch_mm", (1.67, 1.25, 1.0, 0.625), "mm"),
        *line("camera sub-steps", "camera_substeps", (2, 4)),
        *line("scans", "scans_per_ms", (1, 2, 10), "a ms"),
    ),
)

GRASP_ERRORS = ("error_share_lost", "error_mm_moved")
ERRORS = (*SLIP_ERRORS, *GRASP_ERRORS)
TITLES = {
    "error_ms_gross_slip": "onset of gross slip, truth",
    "error_ms_label": "onset according to labels",
    "error_share_detection": "trials with a shifted first detection",
    "error_px_dots": "tracked dots",
    "error_n_shear": "shear force from dots",
    "error_mm_moved": "object moved in the gripper",
}
SLICE_MS = 1.0  # onsets are whole slices


class Measured:
    """The errors and run times of one setting, an entry per trial."""

    def __init__(self, setting: SolverSetting) -> None:
        self.setting = setting
        self.trials: Rows = []
        self.errors: dict[str, list[float]] = {name: [] for name in ERRORS}
        self.detection_moved_ms: list[float] = []
        self.chain_us: list[float] = []
        self.record_us: list[float] = []
        self.grasp_us: list[float] = []

    def add(
        self,
        trial: ChainTrial,
        results: tuple[Chain, Lifted],
        slip_errors: dict[str, float],
        reference: tuple[Chain, Lifted],
    ) -> None:
        """Append the results of a trial, compared with those of the reference."""
        chain, lifted = results
        both_held = lifted.held and reference[1].held
        moved = abs(lifted.moved_mm - reference[1].moved_mm) if both_held else float("nan")
        errors = {**slip_errors, "error_share_lost": float(not lifted.held), "error_mm_moved": moved}
        for name, value in errors.items():
            self.errors[name].append(value)
        self.detection_moved_ms.append(detection_moved_ms(chain, reference[0]))
        self.trials.append(
            {
                "trial_flags": f"--object {trial.object} --seed {trial.seed} {self.setting.flags}".rstrip(),
                "gross_slip_ms": chain.gross_slip_ms,
                "label_ms": chain.label_ms,
                "detection_ms": chain.detection_ms,
                "detection_moved_ms": finite_or_none(self.detection_moved_ms[-1]),
                **{name: finite_or_none(errors[name]) for name in SLIP_ERRORS},
                "grasped_object": trial.grasped,
                "held": lifted.held,
                "moved_mm": lifted.moved_mm,
            }
        )
        self.chain_us.append(chain.chain_us)
        self.record_us.append(chain.record_us)
        self.grasp_us.append(lifted.grasp_us)

    def of(self, name: str) -> Floats:
        """Return an error over the trials."""
        return np.array(self.errors[name])


def trials(count: int, seed: int) -> list[ChainTrial]:
    """Return trials with seeds starting at `seed`, each with an object that slips and one that is grasped."""
    return [ChainTrial(OBJECTS[k % len(OBJECTS)], seed + k, GRASPED[k % len(GRASPED)]) for k in range(count)]


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return a row per setting including the reference, per paired difference from the defaults, and per trial."""
    settings = [FINEST if params.full else REFERENCE, DEFAULTS, *CHOICES.pick(params.full)]
    tried = trials(params.trials or TRIALS.pick(params.full), params.seed)
    measured = [Measured(setting) for setting in settings]
    done, total = 0, len(CALIBRATION) + len(settings) * len(tried)
    calibration = []
    for trial in CALIBRATION:
        with TemporaryDirectory() as folder:
            calibration.append(run_chain(trial, DEFAULTS, Path(folder)))
        done += 1
        progress(done, total)
    force = fit_force(calibration)
    started = time.process_time()
    for trial in tried:
        reference: tuple[Chain, Lifted] | None = None
        for entry in measured:
            with TemporaryDirectory() as folder:  # files of all settings have the same names
                results = run_chain(trial, entry.setting, Path(folder)), run_grasp(trial, entry.setting, Path(folder))
            reference = reference or results
            entry.add(trial, results, slip_errors(results[0], reference[0], force), reference)
            done += 1
            progress(done, total)
    minutes_a_trial = (time.process_time() - started) / 60.0 / len(tried)
    return tables(measured, Effort(params, len(tried), minutes_a_trial))


def tables(measured: Sequence[Measured], effort: Effort) -> Rows:
    """Return the three tables; `measured` begins with the reference and the defaults."""
    reference, defaults, *_ = measured
    fronts = _fronts(measured[1:])
    rows: Rows = [_row(reference, None)]
    rows += [_row(entry, [name for name in ERRORS if fronts[name][at]]) for at, entry in enumerate(measured[1:])]
    for name in ERRORS:
        for entry in measured[2:]:
            shares = _shares(name, entry.of(name), defaults.of(name))
            apart = difference(entry.of(name), defaults.of(name), _resolution(name))
            apart = share_difference(*shares) if shares else apart
            rows.append(
                {
                    "error": name.removeprefix("error_"),
                    "setting": entry.setting.name,
                    "more_than_defaults": finite_or_none(apart.mean),
                    "interval_low": finite_or_none(apart.low),
                    "interval_high": finite_or_none(apart.high),
                    "trials": apart.trials,
                    **effort.deciding(apart, shares),
                }
            )
    return rows + [row for entry in measured for row in entry.trials]


def _shares(name: str, ours: Floats, theirs: Floats) -> tuple[Flags, Flags] | None:
    """Return the trials in which an error occurs, ours and theirs, if both are known; None unless it is a share."""
    if not name.startswith("error_share"):
        return None
    both = np.isfinite(ours) & np.isfinite(theirs)
    return ours[both] > 0.0, theirs[both] > 0.0


def _resolution(name: str) -> float:
    return SLICE_MS if name.startswith("error_ms") else 0.0


def _fronts(candidates: Sequence[Measured]) -> dict[str, list[bool]]:
    """Return for each error which settings are certainly on its Pareto front with the run time of the relevant part."""
    fronts = {}
    for name in ERRORS:
        times = [np.array(one.grasp_us if name in GRASP_ERRORS else one.chain_us) for one in candidates]
        fronts[name] = on_front([one.of(name) for one in candidates], times, _resolution(name))
    return fronts


def _row(entry: Measured, front: list[str] | None) -> Row:
    """Return the row of a setting; front: the errors on whose Pareto front it is, None for the reference."""
    own = front is None  # a reference has no errors against itself, except those of labels, tracker and regression
    compared_with_itself = ("error_ms_gross_slip", "error_share_detection", "error_mm_moved") if own else ()
    errors = {name: None if name in compared_with_itself else _mean(entry.of(name)) for name in ERRORS}
    on = None if front is None else ", ".join(name.removeprefix("error_") for name in front) or "none"
    return {
        "setting": entry.setting.name,
        "flags": entry.setting.flags or "none",
        "trials": len(entry.chain_us),
        **errors,
        "detection_moved_ms_median": None if own else _median(np.array(entry.detection_moved_ms)),
        **run_times(np.array(entry.chain_us)),
        "record_us_median": float(np.median(entry.record_us)),
        "grasp_us_median": float(np.median(entry.grasp_us)),
        "pareto": on,
    }


def _mean(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def _median(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def summary(rows: Rows) -> dict[str, Any]:
    """Return the numbers of settings and trials, and the commands to which a row's flags belong."""
    settings = [row for row in rows if "flags" in row]
    return {
        "settings": len(settings),
        "trials": settings[0]["trials"],
        "reference": settings[0]["flags"],
        "trial": "evetac record --scene slip TRIAL_FLAGS",
        "grasp": "evetac grasp --object GRASPED_OBJECT --seed N --controller paper --model shipped"
        f" --lift-s {LIFT_S:g} --balance-s {BALANCE_S:g} FLAGS",
    }


def size_in(rows: Rows) -> tuple[float, float]:
    """Return width and height of the plot in inches."""
    return 13.0, 7.6


def draw(figure: Any, rows: Rows, errors: Sequence[str]) -> None:
    """Plot each error over the run time of the chain, with lines from the defaults; filled if on the Pareto front."""
    settings = [row for row in rows if "flags" in row]
    lines: dict[str, Rows] = {}
    for row in settings[1:]:
        lines.setdefault(row["setting"].partition(", ")[0], []).append(row)
    names = [name for name in errors if name in TITLES]
    panels = picture.panels(figure, len(names), 3)
    for axes, name in zip(panels, names, strict=True):
        time = "grasp_us_median" if name in GRASP_ERRORS else "time_us_median"
        for number, (line_name, members) in enumerate(lines.items()):
            points = sorted((row for row in members if row[name] is not None), key=lambda row: float(row[time]))
            style = {**picture.series(number), "linestyle": "none"}
            around = [row for row in (settings[1], *points) if row[name] is not None]
            around.sort(key=lambda row: float(row[time]))
            axes.plot([row[time] for row in around], [row[name] for row in around], color=style["color"], linewidth=0.8)
            own = {"label": line_name, "mfc": "white", **style}
            axes.plot([row[time] for row in points], [row[name] for row in points], **own)
            best = [row for row in points if name.removeprefix("error_") in row["pareto"].split(", ")]
            axes.plot([row[time] for row in best], [row[name] for row in best], **style)
        if settings[0][name] is not None:
            axes.axhline(settings[0][name], color="0.5", linewidth=1, linestyle=":", label="reference")
        unit, top = name.split("_")[1], max((row[name] for row in settings if row[name] is not None), default=0.0)
        axes.set(
            title=TITLES[name], ylabel=f"error [{'N' if unit == 'n' else unit}]", ylim=(0, 1.1 * top if top else 1.0)
        )
        what = "simulated ms of the grasp" if name in GRASP_ERRORS else "recorded ms, whole chain"
        axes.set_xlabel(f"run time of a {what}, median [us]")
    picture.legend(figure, panels, title="filled: certainly on the Pareto front")
