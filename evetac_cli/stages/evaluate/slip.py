"""evaluate slip: slip timing and F1 of models on trajectories they never saw (paper, "Evaluation Procedure & Metrics").

Several models are evaluated at once. Those that differ in their seed alone are one setting, and a setting's figures are
means over objects and seeds, as in the paper's bars: every object counts the same in every seed. Each model is
evaluated at its own threshold, which `train` chose on validation trajectories; slip that is predicted ahead of time is
counted against shifted labels in F1 and against the unshifted onset in the timing.

The rows are five tables with different columns: the figures of a setting beside the paper's; how long before or after
the labels' onset it first detected slip; the figures by object; by model; by trajectory.
"""

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.kernels.slip import metrics
from evetac_cli.params.evaluation import EvaluateSlip
from evetac_cli.params.parameter import recipe_of
from evetac_cli.stages.evaluate import ModelsReportJob, Rows, picture, report, report_job
from evetac_cli.stages.evaluate.slip_models import AT_ONCE, Model, check, predict_all
from evetac_cli.stages.evaluate.slip_tables import tables
from evetac_cli.stages.related_files import named_files
from evetac_cli.store.files import StageFile

OUTPUT = "report"
METHOD = 5

SHOWN_MS = (-60, 40)  # of the paper's figure of slip timing
PANELS = 4  # distributions side by side
TITLE_WIDTH = 38  # characters above one

# On a terminal: a table of trajectories up to so many rows, and the columns that it shows, by their short names.
FEW_TRAJECTORIES = 10
MOST_VERDICTS = 8
OF_TRAJECTORIES = {
    "file": "file",
    "setting": "model",
    "t_c_ms": "t_c_ms",
    "t_m_ms": "t_m_ms",
    "t_m_minus_t_c_ms": "late_by_ms",
    "timing": "timing",
}
OF_SETTINGS = {
    "setting": "setting",
    "seeds": "seeds",
    "trajectories": "trajectories",
    "slip_early": "early",
    "slip_correct": "correct",
    "slip_late": "late",
    "f1": "f1",
    "paper_slip_correct": "paper_correct",
    "paper_f1": "paper_f1",
}


def jobs(files: list[Path], params: EvaluateSlip, out: Path | None) -> list[ModelsReportJob]:
    """One report over all features files and models."""
    features, models = split_models(files, params.model)
    if not features:
        raise InputError(
            "no features files are given", expected="labelled features that the models were not trained on"
        )
    (job,) = report_job(features, "slip", out, *models)
    return [ModelsReportJob(job.inputs, job.output, len(models))]


@dataclass(frozen=True)
class JudgingJob(ModelsReportJob):
    """A few trajectories of a report, to be judged by all its models before it is made."""


def parts(job: ModelsReportJob, params: EvaluateSlip) -> list[JudgingJob]:
    """What can be judged at the same time, and is then found by the report."""
    split = len(job.inputs) - job.models
    paths, models = job.inputs[:split], job.inputs[split:]
    return [
        JudgingJob((*paths[begin : begin + AT_ONCE], *models), _kept(job) / f"{begin}", job.models)
        for begin in range(0, split, AT_ONCE)
    ]


def _kept(job: Job) -> Path:
    """The folder of what the models judged."""
    return job.output.with_name(job.output.name.removesuffix(".h5").removesuffix(".report") + ".judged")


def split_models(files: list[Path], given: Path | None) -> tuple[list[Path], list[Path]]:
    """Separate models from other files: a shell puts all but the first of `--model models/*.model.h5` among these.

    `given` is a model file, a folder of them, or a glob. A model that is given twice, even as two files, counts once.
    InputError without a model.
    """
    named = named_files(given, "model", "--model") if given is not None else []
    models: dict[str, Path] = {}
    others: list[Path] = []
    for path, kind in [*((path, "model") for path in named), *((path, None) for path in files)]:
        with StageFile(path, kind) as file:
            if file.kind == "model":
                models.setdefault(file.header["id"], path)
            else:
                others.append(path)
    if not models:
        raise InputError("no model file is named", where="--model", expected="model files, or their folder")
    return others, list(models.values())


def run(job: ModelsReportJob, params: EvaluateSlip, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Rows of settings, timing, objects, models and trajectories, and a picture of them."""
    split = len(job.inputs) - job.models
    paths = job.inputs[:split]
    models = [Model.read(path) for path in job.inputs[split:]]
    headers = check(models, paths)
    if isinstance(job, JudgingJob):
        predict_all(models, paths, headers, progress, job.output.parent)
        return Outcome([], simulated=False)
    thresholds = [model.threshold if params.threshold is None else params.threshold for model in models]
    parameters: dict[str, Any] = {**recipe_of(params), "thresholds": thresholds}

    def measure() -> tuple[Rows, dict[str, Any]]:
        predictions = predict_all(models, paths, headers, progress, _kept(job))
        return tables(models, thresholds, predictions, paths)

    parents = [*(model.header for model in models), *headers]
    outcome = report(job, "evaluate slip", METHOD, parameters, parents, measure, force=force)
    size_in = _size_in(outcome.rows)
    return picture.beside(outcome, job.output, lambda figure: _draw(figure, outcome), size_in)


def for_people(rows: Rows, params: EvaluateSlip) -> tuple[Rows, list[str]]:
    """What a terminal shows: every trajectory of a model that judged few, else a row a setting; and the verdict."""
    settings = _settings(rows)
    trajectories = [row for row in rows if "t_c_ms" in row]
    verdict = [_verdict(row) for row in settings[:MOST_VERDICTS]]
    verdict.append(
        f"Correct is from {-metrics.EARLIEST_MS} ms before the labels' onset, t_c, to {metrics.LATEST_MS} ms after it,"
        " as in the paper; earlier is early, later or never is late."
    )
    if params.all_tables:
        return rows, verdict
    verdict.append("--all prints every table, --json every row.")
    few = len(trajectories) <= FEW_TRAJECTORIES
    shown, names = (trajectories, OF_TRAJECTORIES) if few else (settings, OF_SETTINGS)
    known = [name for name in names if any(row[name] is not None for row in shown) or not name.startswith("paper_")]
    return [{names[name]: row[name] for name in known} for row in shown], verdict


def _verdict(row: dict[str, Any]) -> str:
    """What a setting came to, in a sentence."""
    count = f"{row['trajectories']} trajectories" + (f", {row['seeds']} models" if row["seeds"] > 1 else "")
    if row["slip_correct"] is None:
        return f"{row['setting']}: no trajectory slips ({count}), so there is no timing."
    f1 = "" if row["f1"] is None else f", F1 {row['f1']:.2f}"
    shares = ", ".join(f"{name} {row[f'slip_{name}']:.0%}" for name in ("early", "late") if row[f"slip_{name}"])
    timing = f"slip timing correct {row['slip_correct']:.0%}" + (f" ({shares})" if shares else "")
    return f"{row['setting']}: {timing}{f1}; {count}."


def _size_in(rows: Rows) -> tuple[float, float]:
    """Width and height in inches: room for every setting's bars and panel."""
    settings = len(_settings(rows))
    return 13.0, 1.5 + 0.42 * settings + 3.1 * -(-settings // PANELS)


def _draw(figure: Any, outcome: Outcome) -> None:
    """Bars of timing and F1 with the paper's figures, and below, for each setting, the CDF of t_m - t_c."""
    settings = _settings(outcome.rows)
    rows = -(-len(settings) // PANELS)
    above, below = figure.subfigures(2, 1, height_ratios=[1.2 + 0.42 * len(settings), 3.1 * rows])
    timing, f1 = above.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    above.suptitle("Slip timing and F1, mean and sd over objects and seeds" + _simulated(outcome), fontsize=12)
    at = np.arange(len(settings), dtype=float)
    bars = (
        ("slip_early", "too early", picture.EARLY),
        ("slip_correct", "correct", picture.CORRECT),
        ("slip_late", "too late", picture.LATE),
    )
    for place, (key, label, colour) in enumerate(bars):
        lengths = [row[key] or 0.0 for row in settings]
        errors = [row["slip_correct_sd"] or 0.0 for row in settings] if key == "slip_correct" else None
        timing.barh(at + 0.27 * (place - 1), lengths, 0.25, xerr=errors, color=colour, label=label)
    errors = [row["f1_sd"] or 0.0 for row in settings]
    f1.barh(at, [row["f1"] or 0.0 for row in settings], 0.5, xerr=errors, color=picture.CORRECT)
    for axes, key, title in ((timing, "slip_correct", "share of trajectories"), (f1, "f1", "F1")):
        published = [(row[f"paper_{key}"], y) for row, y in zip(settings, at, strict=True)]
        published = [pair for pair in published if pair[0] is not None]
        axes.plot([x for x, _ in published], [y for _, y in published], label="the paper", **picture.PAPER)
        axes.set(xlim=(0, 1.05), xlabel=title)
        picture.quiet_grid(axes)
    timing.set_yticks(at, [row["setting"] for row in settings])
    timing.invert_yaxis()
    timing.legend(loc="upper left", bbox_to_anchor=(0, -0.12), ncols=4, fontsize=8, frameon=False)
    panels = below.subplots(rows, PANELS, sharey=True, squeeze=False).ravel()
    below.suptitle("First detection against the labels' onset: share detected by then", fontsize=12)
    trajectories = [row for row in outcome.rows if "t_c_ms" in row]
    for axes, row in zip(panels, settings, strict=False):
        _draw_cdf(axes, [one for one in trajectories if one["setting"] == row["setting"]], row["setting"])
    for axes in panels[len(settings) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    below.legend(handles, labels, loc="outside lower center", ncols=10, fontsize=8, frameon=False)


def _draw_cdf(axes: Any, trajectories: Rows, title: str) -> None:
    """A thin line for every object, a thick one for all, a mark for every detection.

    Why so: the plain share of trajectories, where the paper smooths with a Gaussian kernel. Detections that are far too
    early, which all models have, would make the kernel as wide as the range that is shown.
    """
    slips = [row for row in trajectories if row["t_c_ms"] is not None]
    steps = np.arange(SHOWN_MS[0], SHOWN_MS[1] + 1)
    groups = {row["object"]: [one for one in slips if one["object"] == row["object"]] for row in slips}
    for number, (name, rows) in enumerate([*groups.items(), ("all", slips)]):
        late_by = np.array([row["t_m_minus_t_c_ms"] for row in rows if row["t_m_minus_t_c_ms"] is not None])
        share = (late_by[:, None] <= steps).sum(axis=0) / max(len(rows), 1)
        if name == "all":
            axes.step(steps, share, where="post", color="black", linewidth=2, label=name)
            axes.plot(late_by, np.full(len(late_by), -0.04), "|", color="black", markersize=5, alpha=0.4)
        else:
            axes.step(steps, share, where="post", color=f"C{number % 10}", linewidth=0.8, label=f"object {name}")
    axes.axvspan(metrics.EARLIEST_MS, metrics.LATEST_MS, color=picture.CORRECT, alpha=0.08)
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlim=SHOWN_MS, ylim=(-0.08, 1.02), xlabel="t_m - t_c [ms]")
    axes.set_title(textwrap.fill(title, TITLE_WIDTH, break_on_hyphens=False), fontsize=8)


def _settings(rows: Rows) -> Rows:
    return [row for row in rows if "seeds" in row]


def _simulated(outcome: Outcome) -> str:
    return " (simulated)" if outcome.simulated else ""
