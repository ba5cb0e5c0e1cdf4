"""evaluate slip: slip timing and F1 of models on unseen trajectories (paper, "Evaluation Procedure & Metrics").

Several models are evaluated together. Models that differ only in their seed form one setting. The figures of a setting
are means over objects and seeds, as in the paper's bars: every object counts the same in every seed. Each model is
evaluated at its own threshold, which `train` chose on validation trajectories. For models that predict slip ahead of
time, F1 uses shifted labels and timing uses the unshifted onset.

Timing considers the first slice that reaches the threshold. A controller instead acts on alarms: three slices in a row.
So further columns report how long before slip the alarm begins that lasts until slip, and how often alarms occur
without slip (slip_warnings.py).

The rows form nine tables with different columns:

- the covariates of the slips, which decide how far the figures of two data sets can be compared (slip_models.py);
- the figures of each setting next to the paper's;
- the times from the labels' onset to the first detection;
- reliability: predicted probability against frequency of slip;
- predictions over time about the onset, by object;
- the figures by object; by sensor; by model; by trajectory.

With --truth, simulated trials are judged by the true onset instead of the labels'. Then no trial is left out, and the
paper's figures, which are relative to labels, are not shown.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.columns import columns_of
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError, made_by
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.marks import LABELS, TRUTH, Source
from evetac_cli.evaluate.common.report import ModelsReportJob, report, report_job
from evetac_cli.evaluate.slip import PAPER, EvaluateSlip
from evetac_cli.evaluate.slip import models as slip_models
from evetac_cli.evaluate.slip import warnings as slip_warnings
from evetac_cli.evaluate.slip.models import AT_ONCE, Model, check, predict_all
from evetac_cli.evaluate.slip.tables import tables
from evetac_cli.jobs import Job, Outcome, Progress, Rows, Stage, silent
from evetac_cli.kernels.slip import metrics
from evetac_cli.resources import with_shipped
from evetac_cli.stages.model_files import why_useless
from evetac_cli.stages.related_files import OTHER_FOLDER, Origins, named_files
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.onset import abstains, in_short, labelled_onset

METHOD = 12

SHOWN_MS = (-60, 40)  # range of the paper's figure of slip timing
PANELS = 4  # distributions side by side
TITLE_WIDTH = 38  # characters per line of a panel's title

# On a terminal: up to this many trajectories are listed, with these columns and their short names.
FEW_TRAJECTORIES = 10
MOST_VERDICTS = 8
BY = {"sensor": {"sensor", "counted"}, "object": {"object", "counted"}, "model": {"seed", "slips"}}  # columns of rows
OF_TRAJECTORIES = ("file", "setting", "t_c_ms", "t_m_ms", "t_m_minus_t_c_ms", "timing", "abstained")
SHARES = (  # of a group of trials, with how many they are
    *("trajectories", "counted", "abstained", "no_slip"),
    *("slip_early", "slip_correct", "slip_late", "warned_10_ms", "false_alarms_per_min", "f1"),
)
OF_GROUPS = ("sensor", "object", "file", "setting", *SHARES)  # of --by
OF_SETTINGS = ("setting", "seeds", *SHARES, "paper_slip_correct", "paper_f1")
SHORT = {one.name: one.short for one in columns_of("evaluate slip").values() if one.short}


def jobs(files: list[Path], params: EvaluateSlip, out: Path | None) -> list[ModelsReportJob]:
    """Return one report job over all features files and models."""
    features, models = split_models(files, params.model)
    if not features:
        expected = "labelled features of trajectories that the models were not trained on"
        raise InputError("no features files given", expected=expected, hint=made_by("features"))
    (job,) = report_job(features, "slip-truth" if params.truth else "slip", out, *models)
    return [ModelsReportJob(job.inputs, job.output, len(models))]


@dataclass(frozen=True)
class JudgingJob(ModelsReportJob):
    """A few trajectories of a report, evaluated by all its models in advance."""


def cautions(jobs: Sequence[ModelsReportJob], params: EvaluateSlip) -> list[str]:
    """Return a warning for each model that detects nothing at its own threshold."""
    warnings = []
    for path in jobs[0].inputs[len(jobs[0].inputs) - jobs[0].models :] if params.threshold is None else ():
        with StageFile(path, "model") as file:
            warnings += [f"{path} is not a slip detector: {why}" for why in [why_useless(file)] if why]
    return warnings


def parts(job: ModelsReportJob, params: EvaluateSlip) -> list[JudgingJob]:
    """Return jobs that can run in parallel; the report then finds their results."""
    split = len(job.inputs) - job.models
    paths, models = job.inputs[:split], job.inputs[split:]
    return [
        JudgingJob((*paths[begin : begin + AT_ONCE], *models), _kept(job) / f"{begin}", job.models)
        for begin in range(0, split, AT_ONCE)
    ]


def _kept(job: Job) -> Path:
    """Return the folder of the stored probabilities."""
    return job.output.with_name(job.output.name.removesuffix(".h5").removesuffix(".report") + ".judged")


def split_models(files: list[Path], model_path: Path | None) -> tuple[list[Path], list[Path]]:
    """Separate models from other files: a shell puts all but the first of `--model models/*.model.h5` among the files.

    `model_path` is a model file, a folder of them, a glob or `shipped`, or several of these with commas. A model
    that is given twice, even as two files, counts once. Raises InputError if there is no model.
    """
    given = str(model_path or "")
    names = [given] if given and Path(given).exists() else [name for name in given.split(",") if name]
    model_files = [path for name in names for path in named_files(name, "model", "--model")]
    models: dict[str, Path] = {}
    others: list[Path] = []
    for path, kind in [*((path, "model") for path in model_files), *((path, None) for path in with_shipped(files))]:
        with StageFile(path, kind) as file:
            if file.kind == "model":
                models.setdefault(file.header["id"], path)
            else:
                others.append(path)
    if not models:
        raise InputError("no model file given", where="--model", hint=made_by("model"))
    return others, list(models.values())


def run(job: ModelsReportJob, params: EvaluateSlip, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return rows of settings, timing, objects, models and trajectories, and plot them."""
    split = len(job.inputs) - job.models
    paths = job.inputs[:split]
    models = [Model.read(path) for path in job.inputs[split:]]
    headers = check(models, paths, labels_needed=not params.truth)
    recordings = slip_models.with_truth(paths, params.recordings)
    true = _all_with_truth(paths, recordings) if params.truth else None
    if isinstance(job, JudgingJob):
        predict_all(models, paths, headers, progress, job.output.parent, true)
        return Outcome([], simulated=False)
    thresholds = [model.threshold_for(params.threshold, params.false_alarms_per_min) for model in models]
    # A report that has the truth of more or fewer recordings is a different report.
    truth_count = len(recordings) - recordings.count(None)
    parameters: dict[str, Any] = {**recipe_of(params), "thresholds": thresholds, "with_truth": truth_count}

    def measure() -> tuple[Rows, dict[str, Any]]:
        predictions = predict_all(models, paths, headers, progress, _kept(job), true)
        doubts = {} if params.truth else _doubts(paths)
        judged_by = TRUTH if params.truth else LABELS
        rows, summary = tables(models, thresholds, predictions, paths, doubts=doubts, judged_by=judged_by)
        covariates = slip_models.covariate_rows(paths, recordings, doubts)
        return [*covariates, *rows], {**summary, "with_truth": truth_count}

    parents = [*(model.header for model in models), *headers]
    outcome = report(job, "evaluate slip", METHOD, parameters, parents, measure, force=force)
    size_in = _size_in(outcome.rows)
    return picture.beside(outcome, job.output, lambda figure: _draw(figure, outcome, Source.of(parents)), size_in)


def _all_with_truth(paths: Sequence[Path], recordings: Sequence[Path | None]) -> list[Path]:
    """Return the simulated recordings; InputError if one of them is missing or has no truth."""
    for path, recording in zip(paths, recordings, strict=True):
        if recording is None:
            with StageFile(path, "features") as features:
                real = not features.header["simulated"]
                at = None if real else Origins("recording").must_find(features, OTHER_FOLDER)
            found = "a trial of a real sensor" if real else f"{at}, which has no truth or is another recording"
            expected, hint = "a simulated recording, with its ground truth", "leave out --truth"
            raise InputError("no truth to judge by", where=str(path), expected=expected, found=found, hint=hint)
    return [recording for recording in recordings if recording is not None]


def _doubts(paths: Sequence[Path]) -> dict[Path, str]:
    """Return for features whose labels abstain the reason, which their labels file contains."""
    origins = Origins("labels")
    doubts = {}
    for path in paths:
        with StageFile(path, "features") as features:
            if not abstains(features):
                continue
            doubts[path] = "the labels file with the reason was not found"
            found = origins.find(features)
        if found is not None:
            with StageFile(found, "labels") as labels:
                if labels.header["id"] in features.header["parents"]:
                    doubts[path] = labelled_onset(labels).doubt
    return doubts


def for_people(rows: Rows, params: EvaluateSlip) -> tuple[Rows, list[str]]:
    """Return the rows for a terminal, and the results in sentences.

    With few trajectories there is a row for each, otherwise a row per setting; with --by, a row per group.
    """
    settings = _settings(rows)
    trajectories = [row for row in rows if "t_c_ms" in row]
    verdict = [_verdict(row) for row in settings[:MOST_VERDICTS]]
    verdict += _left_out(settings[0], trajectories)
    by_truth = settings[0]["judged_by"] == TRUTH
    onset = "true onset of gross slip, t_s" if by_truth else "labels' onset, t_c"
    verdict.append(
        f"Correct: from {-metrics.EARLIEST_MS} ms before the {onset}, to {metrics.LATEST_MS} ms after it,"
        " as in the paper. Earlier is early; later or never is late."
    )
    verdict += slip_models.missing_covariates(rows)
    if params.all_tables:
        return rows, verdict
    verdict.append("--all prints every table; --json prints every row.")
    few = len(trajectories) <= FEW_TRAJECTORIES
    columns: tuple[str, ...] = OF_TRAJECTORIES if few else OF_SETTINGS
    shown, names = trajectories if few else settings, SHORT
    if params.by:
        shown, names = [row for row in rows if BY[params.by] <= row.keys()], {**SHORT, "file": "model_file"}
        columns = tuple(name for name in OF_GROUPS if any(name in row for row in shown))
    if columns is not OF_SETTINGS:
        names = {**names, "setting": "model"}
    optional = ("paper_", "abstained", "no_slip")
    columns = tuple(name for name in columns if not name.startswith(optional) or any(row[name] for row in shown))
    if by_truth:
        names = {**names, "t_c_ms": "t_s_ms"}
    covariates = [] if params.by else [row for row in rows if "covariate" in row]
    return [*covariates, *({names.get(name, name): row.get(name) for name in columns} for row in shown)], verdict


def _verdict(row: dict[str, Any]) -> str:
    """Return the result of a setting in a sentence."""
    count = f"n = {row['counted']} of {row['trajectories']} trajectories"
    left_out = [f"{row[key]} {words}" for key, words in (("abstained", "abstained"), ("no_slip", "without slip"))]
    count = ", ".join([count, *(words for words in left_out if not words.startswith("0 "))])
    count += f"; {row['seeds']} models" if row["seeds"] > 1 else ""
    count += "; judged by truth of the simulation" if row["judged_by"] == TRUTH else ""
    if row["slip_correct"] is None:
        return f"{row['setting']}: no slip with a known onset, so timing is undefined; {count}."
    f1 = "" if row["f1"] is None else f", F1 {row['f1']:.2f}"
    shares = ", ".join(f"{name} {row[f'slip_{name}']:.0%}" for name in ("early", "late") if row[f"slip_{name}"])
    timing = f"slip timing correct {row['slip_correct']:.0%}" + (f" ({shares})" if shares else "")
    return f"{row['setting']}: {timing}{f1}{_warned(row)}; {count}."


def _left_out(row: dict[str, Any], trajectories: Rows) -> list[str]:
    """Return why trajectories are left out of timing and warnings, and over how many objects the means are."""
    of_one = [one for one in trajectories if one["model_file"] == trajectories[0]["model_file"]]
    whys = [one["abstained_because"] for one in of_one if one["abstained"]]
    lines = []
    if row["abstained"]:
        lines.append(
            f"Timing and warnings leave out the {row['abstained']} trajectories whose labels abstain: {in_short(whys)}."
        )
    if len({one["object"] for one in trajectories}) > 1:
        lines.append(f"Shares are means over the objects with such slips, {row['objects_counted']} here.")
    return lines


def _warned(row: dict[str, Any]) -> str:
    """Return the share of slips with a warning, and the rate of false alarms, in words."""
    share = row.get("warned_10_ms")
    if share is None:
        return ""
    false = row["false_alarms_per_min"]
    price = "" if false is None else f", {false:.2g} false alarms per minute"
    return f"; warned at least 10 ms ahead {share:.0%}{price}"


def _size_in(rows: Rows) -> tuple[float, float]:
    """Return width and height in inches, with room for every setting's bars and panel."""
    return 12.0, sum(_heights_in(len(_settings(rows))))


def _heights_in(settings: int) -> tuple[float, float, float]:
    """Return the heights of the bars, of the panels below them, and of warnings and reliability at the end."""
    return 1.6 + 0.55 * settings, 0.9 + 2.5 * math.ceil(settings / PANELS), 3.3 + 0.2 * settings


def _draw(figure: Any, outcome: Outcome, source: Source) -> None:
    """Plot bars of timing and F1 by object, with the paper's figures; below, when slips were detected by each setting.

    At the end: how far ahead each setting warns, and how reliable its probabilities are.
    """
    settings = _settings(outcome.rows)
    trajectories = [row for row in outcome.rows if "t_c_ms" in row]
    above, below, last = figure.subfigures(3, 1, height_ratios=_heights_in(len(settings)))
    timing, f1 = above.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    above.suptitle("Timing and F1 of slip detectors" + (" (simulated)" if outcome.simulated else ""))
    by_truth = settings[0]["judged_by"] == TRUTH
    names = []
    for place, row in enumerate(settings):
        slips = row["counted"]
        left_out = f" of {row['trajectories']}, {row['abstained']} abstained" if row["abstained"] else ""
        names.append(f"{picture.plain(_wrapped(row['setting']))}\nslips: {slips}{left_out}; seeds: {row['seeds']}")
        _draw_timing(timing, place, row, slips)
        _draw_f1(f1, place, row, [one for one in outcome.rows if "object" in one and "trajectories" in one])
    for axes, key in ((timing, "paper_slip_correct"), (f1, "paper_f1")):
        for place, row in enumerate(settings):
            if beside := PAPER.beside(key, row, source):
                axes.plot(beside.value, place - 0.14, **picture.of_paper(beside.mark))
        picture.share_axis(axes.xaxis)
    timing.set(xlabel="share of slips by time of first detection", ylim=(len(settings) - 0.4, -0.6))
    timing.set_yticks(range(len(settings)), names)
    f1.set_xlabel("F1 over slices")
    picture.legend(above, (timing, f1))
    panels = picture.panels(below, len(settings), PANELS, sharex=True, sharey=True)
    for axes, row in zip(panels, settings, strict=True):
        _draw_onsets(axes, [one for one in trajectories if one["setting"] == row["setting"]], row["setting"])
    picture.label_x(panels, f"onset by the model minus\n{'true onset' if by_truth else 'onset in the labels'} [ms]")
    below.supylabel("share of slips detected by then", fontsize=9)
    picture.legend(below, panels)
    _draw_warnings(last, settings, [row for row in outcome.rows if "predicted_from" in row])


def _draw_timing(axes: Any, place: int, row: dict[str, Any], slips: int) -> None:
    """Draw a bar of shares that add up to 1, and the interval of the first share."""
    bars = (
        ("slip_correct", "correct", picture.CORRECT),
        ("slip_early", "early", picture.EARLY),
        ("slip_late", "late or never", picture.LATE),
    )
    left = 0.0
    for key, label, colour in bars:
        axes.barh(place, row[key] or 0.0, 0.62, left=left, color=colour, label=label)
        left += row[key] or 0.0
    if slips and row["slip_correct"] is not None:
        label = "95 % interval of correct, over objects and sensors"
        reach = _reach(row, "slip_correct")
        axes.errorbar(row["slip_correct"], place + 0.14, xerr=reach, label=label, **picture.INTERVAL)


def _reach(row: dict[str, Any], name: str) -> list[list[float]]:
    """Return how far an interval extends below and above its value, for matplotlib."""
    value = row[name]
    return [[max(value - row[f"{name}_low"], 0.0)], [max(row[f"{name}_high"] - value, 0.0)]]


def _draw_warnings(figure: Any, settings: Rows, steps: Rows) -> None:
    """Plot the share of slips with at least a given warning time, and predicted probability against slip frequency."""
    warned, calibration = figure.subplots(1, 2, width_ratios=[3, 2])
    for number, row in enumerate(settings):
        style, false = picture.series(number), row["false_alarms_per_min"]
        price = "no slice without slip" if false is None else f"{false:.2g} false alarms per min"
        label = f"{picture.plain(row['setting'])}, {price}"
        shares = [row[name] for name in slip_warnings.WARNED.values()]
        if None not in shares:
            warned.plot([*slip_warnings.WARNED], shares, label=label, **style)
            reach = _reach(row, "warned_10_ms")
            interval = {**picture.INTERVAL, "ecolor": style["color"]}
            warned.errorbar(10, row["warned_10_ms"], yerr=reach, **interval)
        of_setting = [step for step in steps if step["setting"] == row["setting"]]
        calibration.plot([step["predicted"] for step in of_setting], [step["observed"] for step in of_setting], **style)
    calibration.plot([0, 1], [0, 1], color="0.5", linewidth=0.8, label="perfectly calibrated")
    warned.set(xlabel="minimum warning time [ms]", ylabel="share of slips", xticks=[*slip_warnings.WARNED])
    calibration.set(xlabel="predicted probability of slip", ylabel="share that slips")
    for axis in (warned.yaxis, calibration.xaxis, calibration.yaxis):
        picture.share_axis(axis)
    picture.legend(figure, (warned, calibration))


def _draw_f1(axes: Any, place: int, row: dict[str, Any], objects: Rows) -> None:
    """Draw a marker for every object, and a larger one for their mean."""
    of_setting = [one["f1"] for one in objects if one["setting"] == row["setting"] and one["f1"] is not None]
    if len(of_setting) > 1:
        style = {"color": picture.COLOURS[4], "marker": "o", "markersize": 4, "linestyle": "none", "alpha": 0.7}
        axes.plot(of_setting, np.full(len(of_setting), place + 0.14), label="F1 of an object", **style)
    if row["f1"] is not None:
        axes.plot(row["f1"], place, "o", color=picture.CORRECT, markersize=8, label="F1, mean over objects and seeds")


def _draw_onsets(axes: Any, trajectories: Rows, setting: str) -> None:
    """Plot the share of slips detected by each time: a thin line per object, a thick one for all, a tick per detection.

    This is the plain share of trajectories, whereas the paper smooths with a Gaussian kernel. Detections that are far
    too early, which all models have, would make the kernel as wide as the plotted range.
    """
    slips = [row for row in trajectories if row["t_c_ms"] is not None]
    steps = np.arange(SHOWN_MS[0], SHOWN_MS[1] + 1)
    groups = [[one for one in slips if one["object"] == name] for name in dict.fromkeys(row["object"] for row in slips)]
    for rows in groups if len(groups) > 1 else []:
        axes.step(steps, _share_by(rows, steps), where="post", color="0.7", linewidth=0.8, label="slips of an object")
    late_by = [row["t_m_minus_t_c_ms"] for row in slips if row["t_m_minus_t_c_ms"] is not None]
    axes.step(steps, _share_by(slips, steps), where="post", color="black", linewidth=2, label="all slips")
    shown = [value for value in late_by if SHOWN_MS[0] <= value <= SHOWN_MS[1]]
    style = {"color": "black", "markersize": 6, "alpha": max(0.15, min(1.0, 10 / max(len(shown), 1)))}
    axes.plot(shown, np.full(len(shown), -0.05), "|", **style)
    label = f"timing correct: {metrics.EARLIEST_MS} to {metrics.LATEST_MS} ms"
    axes.axvspan(metrics.EARLIEST_MS, metrics.LATEST_MS, color=picture.CORRECT, alpha=0.1, linewidth=0, label=label)
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlim=SHOWN_MS, ylim=(-0.1, 1.03), yticks=(0, 0.2, 0.4, 0.6, 0.8, 1.0))
    before = sum(value < SHOWN_MS[0] for value in late_by)
    after = len(slips) - before - len(shown)
    beyond = f"{before} before this range, {after} after it or never; {len(slips)} slips"
    axes.set_title(f"{picture.plain(_wrapped(setting))}\n{beyond}", fontsize=8.5)


def _share_by(slips: Rows, steps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the share of slips that were detected by each step."""
    late_by = np.array([row["t_m_minus_t_c_ms"] for row in slips if row["t_m_minus_t_c_ms"] is not None])
    shares: NDArray[np.float64] = (late_by[:, None] <= steps).sum(axis=0) / max(len(slips), 1)
    return shares


def _wrapped(setting: str) -> str:
    return textwrap.fill(setting, TITLE_WIDTH, break_on_hyphens=False)


def _settings(rows: Rows) -> Rows:
    return [row for row in rows if "seeds" in row]


STAGE = Stage(jobs, run, cautions=cautions, parts=parts, for_people=for_people)
