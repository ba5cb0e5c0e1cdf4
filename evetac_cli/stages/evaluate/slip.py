"""evaluate slip: slip timing and F1 of models on trajectories they never saw (paper, "Evaluation Procedure & Metrics").

Several models are judged at once. Those that differ in their seed alone are one setting, and a setting's figures are
means over objects and seeds, as in the paper's bars: every object counts the same in every seed. Each model is judged
at its own threshold, which `train` chose on validation trajectories; slip that is predicted ahead of time is counted
against shifted labels in F1 and against the unshifted onset in the timing.

The rows are five tables, told apart by their columns: a setting's figures beside the paper's; how far before or after
the labels' onset it first felt slip; the same by object; by model; by trajectory.
"""

import glob
import json
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels import slip
from evetac_cli.kernels.detector import Detector
from evetac_cli.kernels.slip import Prediction
from evetac_cli.params import EvaluateSlip, recipe_of
from evetac_cli.resources import table
from evetac_cli.stages import Job, Outcome, Progress, silent
from evetac_cli.stages.evaluate import Rows, picture, report, report_job
from evetac_cli.stages.train import ahead_of, check_disjoint, detector_of, object_of, predict, read_trajectory
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header

INPUTS = ("features", "model")
OUTPUT = "report"
METHOD = 3
NOT_WEIGHTS = ("weights/input_scale", "weights/input_offset")  # fixed, not trained
# Where t_m - t_c is, in ms: the borders of the paper's "Evaluating Slip Timing".
MOMENTS = (
    ("earlier", -np.inf, slip.EARLIEST_MS - 1),
    ("50_to_31_ms_ahead", slip.EARLIEST_MS, -31),
    ("30_to_11_ms_ahead", -30, -11),
    ("10_to_0_ms_ahead", -10, 0),
    ("1_to_20_ms_after", 1, slip.LATEST_MS),
    ("later", slip.LATEST_MS + 1, np.inf),
)
SHOWN_MS = (-60, 40)  # of the paper's figure of slip timing
PANELS = 4  # distributions side by side
TITLE_WIDTH = 38  # characters above one


@dataclass(frozen=True)
class Model:
    """A trained detector, and what it was made from."""

    path: Path
    header: Header
    architecture: slip.Architecture
    graph_bytes: int
    ahead_ms: int
    threshold: float
    dot_shape: tuple[int, int]
    parameters: int  # trained numbers

    @classmethod
    def read(cls, path: Path) -> "Model":
        """Open a model file; InputError if it is none, or damaged."""
        with StageFile(path, "model") as file:
            rows, columns = (int(size) for size in file.read("dot_shape"))
            shapes = {name: shape for name, (_, shape) in file.contents().items() if name.startswith("weights/")}
            return cls(
                path,
                file.header,
                detector_of(file).architecture,
                file.length("onnx"),
                ahead_of(file),
                float(file.read("threshold")),
                (rows, columns),
                sum(int(np.prod(shape)) for name, shape in shapes.items() if name not in NOT_WEIGHTS),
            )

    def detector(self) -> Detector:
        """The network, ready to run.

        Why so: made when it is needed, because onnxruntime keeps the memory of its largest batch for each network:
        a gigabyte for event images.
        """
        with StageFile(self.path, "model") as file:
            return detector_of(file)

    @property
    def labels(self) -> str:
        """How the onset of slip was found in what it was trained on, `truth` among the ways."""
        history, chosen = self.header["history"], self.header["parameters"]
        features = self.header["parents"][: chosen.get("trained_on")]
        labels = (history[parent] for one in features for parent in history[one]["parents"])
        return ", ".join(sorted({labelled_by(header) for header in labels if header["kind"] == "labels"})) or "none"

    @property
    def objects(self) -> set[str]:
        """The objects of the trajectories that it was trained and validated on."""
        return {object_of({**ancestor, "history": {}}) for ancestor in self.header["history"].values()} - {"unknown"}

    @property
    def setting(self) -> str:
        """What two models share that differ in their seed alone."""
        chosen = {key: value for key, value in self.header["parameters"].items() if key != "seed"}
        return json.dumps([chosen, self.header["parents"]], sort_keys=True)


def labelled_by(header: Header) -> str:
    """The method of a labels header."""
    return str(header["parameters"].get("method", "farneback"))


def jobs(files: list[Path], params: EvaluateSlip, out: Path | None) -> list[Job]:
    """One report over all features files and models."""
    features, models = sort_out(files, params.model)
    (job,) = report_job(features, "slip", out, *models)
    return [job._replace(choice={"models": len(models)})]


def sort_out(files: list[Path], given: Path | None) -> tuple[list[Path], list[Path]]:
    """Tell features and models apart: `--model models/*.model.h5` puts all models but the first among the files.

    `given` is a model file, a folder of them, or a glob. A model that is given twice, even as two files, counts once.
    InputError where either is missing.
    """
    named: list[Path] = []
    if given is not None:
        pattern = str(given / "*.model.h5") if given.is_dir() else str(given)
        named = [Path(name) for name in sorted(glob.glob(pattern))] or [given]
    models: dict[str, Path] = {}
    features: list[Path] = []
    for path, kind in [*((path, "model") for path in named), *((path, None) for path in files)]:
        with StageFile(path, kind) as file:
            if file.kind == "model":
                models.setdefault(file.header["id"], path)
            else:
                features.append(path)
    if not models:
        raise InputError("which model?", where="--model", expected="model files, or their folder")
    if not features:
        raise InputError("on which trajectories?", expected="labelled features that the models never saw")
    return features, list(models.values())


def run(job: Job, params: EvaluateSlip, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Rows of settings, moments, objects, models and trajectories, and a picture of them."""
    split = len(job.inputs) - job.choice["models"]
    paths = job.inputs[:split]
    models = [Model.read(path) for path in job.inputs[split:]]
    headers = check(models, paths)
    thresholds = [model.threshold if params.threshold is None else params.threshold for model in models]
    parameters: dict[str, Any] = {**recipe_of(params), "thresholds": thresholds}

    def measure() -> tuple[Rows, dict[str, Any]]:
        judged = judge(models, paths, headers, progress)
        return _tables(models, thresholds, judged, paths)

    parents = [*(model.header for model in models), *headers]
    outcome = report(job, "evaluate slip", METHOD, parameters, parents, measure, force=force)
    settings = len(_settings(outcome.rows))
    size_in = (13.0, 1.5 + 0.42 * settings + 3.1 * -(-settings // PANELS))
    return picture.beside(outcome, job.output, lambda figure: _draw(figure, outcome), size_in)


def check(models: Sequence[Model], paths: Sequence[Path]) -> list[Header]:
    """Headers of features that these models can be judged on.

    InputError for features without labels, of another dot grid, or of a recording that a model has seen.
    """
    headers = []
    for path in paths:
        with StageFile(path, "features") as file:
            if not file.has("label"):
                raise InputError("these features have no labels", where=str(path), hint="evetac label, then featurize")
            shape = tuple(file.read("dot_shape").tolist())
            for model in models:
                if shape != model.dot_shape:
                    raise InputError(
                        f"another dot grid than that of {model.path}",
                        where=str(path),
                        expected=str(list(model.dot_shape)),
                        found=str(list(shape)),
                    )
            headers.append(file.header)
    for model in models:
        check_disjoint([model.header], headers, f"evaluated on, with {model.path}", paths)
    return headers


def judge(
    models: Sequence[Model], paths: Sequence[Path], headers: Sequence[Header], progress: Progress
) -> list[list[Prediction]]:
    """What every model says of every trajectory, by model. A trajectory is read once for each architecture."""
    found: list[list[Prediction]] = [[] for _ in models]
    done = 0
    for architecture in dict.fromkeys(model.architecture for model in models):
        trajectories = [read_trajectory(path, architecture) for path in paths]
        for model, predictions in zip(models, found, strict=True):
            if model.architecture == architecture:
                detector = model.detector()
                for trajectory, header in zip(trajectories, headers, strict=True):
                    predictions.append(predict(detector, trajectory, header, model.ahead_ms))
                    done += 1
                    progress(done // len(models), len(paths))
    return found


def settings_of(models: Sequence[Model]) -> dict[str, list[int]]:
    """Which models (their indices) belong to which setting; its name says what tells it from the other settings."""
    groups: dict[str, list[int]] = {}
    for index, model in enumerate(models):
        groups.setdefault(model.setting, []).append(index)
    traits = [_traits(models[members[0]]) for members in groups.values()]
    varying = [key for key in traits[0] if len({trait[key] for trait in traits}) > 1]
    named: dict[str, list[int]] = {}
    for trait, members in zip(traits, groups.values(), strict=True):
        name = ", ".join(trait[key] for key in trait if (key in varying or key == "model") and trait[key])
        while name in named:
            name += "'"  # trained on other files, and alike in all else
        named[name] = members
    return named


def _traits(model: Model) -> dict[str, str]:
    chosen = model.header["parameters"]
    return {
        "model": model.architecture.name,
        "ahead": f"{model.ahead_ms} ms ahead" if model.ahead_ms else "",
        "recipe": str(chosen.get("recipe", "")),
        "labels": f"labels {model.labels}",
        "steps": f"up to {chosen.get('max_steps')} steps",
        "epochs": f"{chosen.get('epochs')} epochs",
        "trained_on": f"{chosen.get('trained_on')} trajectories",
    }


def _tables(
    models: Sequence[Model], thresholds: Sequence[float], judged: Sequence[list[Prediction]], paths: Sequence[Path]
) -> tuple[Rows, dict[str, Any]]:
    scores = [slip.score(predictions, at) for predictions, at in zip(judged, thresholds, strict=True)]
    settings: Rows = []
    moments: Rows = []
    objects: Rows = []
    for setting, members in settings_of(models).items():
        first = models[members[0]]
        cells = [by_object(judged[index], thresholds[index]) for index in members]
        late_by = [
            _late_by(prediction, thresholds[index])
            for index in members
            for prediction in judged[index]
            if prediction.onset >= 0
        ]
        settings.append(setting_row(setting, first, cells))
        moments.append({"setting": setting, **_moments(late_by), **_paper_moments(first, set(cells[0]))})
        for name in cells[0]:
            of_object = [cell[name] for cell in cells]
            correct, f1 = _values(of_object, "slip_correct"), _values(of_object, "f1")
            objects.append(
                {
                    "setting": setting,
                    "object": name,
                    "trajectories": of_object[0]["trajectories"],
                    "slip_early": _mean(_values(of_object, "slip_early")),
                    "slip_correct": _mean(correct),
                    "slip_correct_sd_seeds": _sd(correct),
                    "slip_late": _mean(_values(of_object, "slip_late")),
                    "f1": _mean(f1),
                    "f1_sd_seeds": _sd(f1),
                }
            )
    by_model = [
        {"setting": setting, "file": models[index].path.name, "seed": _seed(models[index]), **scores[index]}
        for setting, members in settings_of(models).items()
        for index in members
    ]
    trajectories = [
        _trajectory_row(setting, models[index], thresholds[index], prediction, path)
        for setting, members in settings_of(models).items()
        for index in members
        for prediction, path in zip(judged[index], paths, strict=True)
    ]
    return [*settings, *moments, *objects, *by_model, *trajectories], _summary(scores, settings)


def _seed(model: Model) -> int | None:
    seed: int | None = model.header["parameters"].get("seed")
    return seed


def by_object(predictions: Sequence[Prediction], threshold: float) -> dict[str, dict[str, Any]]:
    """The score of one model on each object's trajectories."""
    groups: dict[str, list[Prediction]] = {}
    for prediction in predictions:
        groups.setdefault(prediction.object, []).append(prediction)
    return {name: slip.score(members, threshold) for name, members in groups.items()}


def _late_by(prediction: Prediction, threshold: float) -> int | None:
    """t_m - t_c in ms; None where nothing was detected."""
    first = slip.onset(prediction.detected(threshold))
    return first - prediction.onset if first >= 0 else None


def setting_row(setting: str, model: Model, cells: list[dict[str, Any]]) -> dict[str, Any]:
    """A setting's figures: means over objects and seeds, beside the paper's.

    `cells`: for every seed, the score of every object. *_sd is over objects and seeds, *_sd_seeds over the seeds'
    means over objects.
    """
    every = [score for cell in cells for score in cell.values()]
    chosen = model.header["parameters"]
    row: dict[str, Any] = {
        "setting": setting,
        "model": model.architecture.name,
        "ahead_ms": model.ahead_ms,
        "recipe": chosen.get("recipe"),
        "labels": model.labels,
        "max_steps": chosen.get("max_steps"),
        "seeds": len(cells),
        "trajectories": sum(score["trajectories"] for score in cells[0].values()),
        "slip_early": _mean(_values(every, "slip_early")),
        "slip_late": _mean(_values(every, "slip_late")),
    }
    for figure in ("slip_correct", "f1"):
        of_seeds = [_mean(_values(list(cell.values()), figure)) for cell in cells]
        row[figure] = _mean(_values(every, figure))
        row[f"{figure}_sd"] = _sd(_values(every, figure))
        row[f"{figure}_sd_seeds"] = _sd([value for value in of_seeds if value is not None])
    return row | _paper(model, set(cells[0]))


def _paper(model: Model, objects: set[str]) -> dict[str, Any]:
    """The paper's figures for the same model, on objects that were or were not trained on; None where it has none.

    The 6 x 6 images of a CPU stand beside the paper's full images.
    """
    name = model.architecture.name.removesuffix("-6x6")
    figures: dict[str, Any] = {"paper_slip_correct": None, "paper_f1": None}
    paper = table("paper")["slip"]
    if "unknown" in objects:
        return figures
    if objects <= model.objects and model.ahead_ms == 0:
        found = paper["training_objects"].get(name, {})
        figures = {"paper_slip_correct": found.get("correct"), "paper_f1": found.get("f1")}
    elif not objects & model.objects and model.ahead_ms in paper["unseen_objects"]["ahead_ms"]:
        at = paper["unseen_objects"]["ahead_ms"].index(model.ahead_ms)
        figures["paper_slip_correct"] = paper["unseen_objects"].get(name, [None] * (at + 1))[at]
    return figures


def _moments(late_by: Sequence[int | None]) -> dict[str, Any]:
    """Shares of the trajectories with an onset, by where t_m - t_c is; the median of those with a detection."""
    told = [value for value in late_by if value is not None]
    shares = {name: sum(low <= value <= high for value in told) for name, low, high in MOMENTS}
    return {
        "t_m_minus_t_c_ms_median": float(np.median(told)) if told else None,
        **{name: count / len(late_by) if late_by else None for name, count in shares.items()},
        "never": (len(late_by) - len(told)) / len(late_by) if late_by else None,
    }


def _paper_moments(model: Model, objects: set[str]) -> dict[str, Any]:
    timing = table("paper")["slip"]["timing"]
    same = timing["model"] == model.architecture.name and timing["ahead_ms"] == model.ahead_ms
    unseen = not objects & (model.objects | {"unknown"})
    return {"paper_10_to_0_ms_ahead": timing["10_to_0_ms_ahead"] if same and unseen else None}


def _trajectory_row(setting: str, model: Model, threshold: float, prediction: Prediction, path: Path) -> dict[str, Any]:
    first = slip.onset(prediction.detected(threshold))
    labelled = prediction.onset >= 0
    return {
        "setting": setting,
        "model_file": model.path.name,
        "file": path.name,
        "object": prediction.object,
        "t_c_ms": prediction.onset if labelled else None,
        "t_m_ms": first if first >= 0 else None,
        "t_m_minus_t_c_ms": first - prediction.onset if labelled and first >= 0 else None,
        "timing": slip.timing(first, prediction.onset) if labelled else None,
        "f1": prediction.counts(threshold).f1,
    }


def _settings(rows: Rows) -> Rows:
    return [row for row in rows if "seeds" in row]


def _summary(scores: Rows, settings: Rows) -> dict[str, Any]:
    """The score of a single model; of several, which setting is the best."""
    if len(scores) == 1:
        return scores[0]
    best: dict[str, Any] = {}
    for figure in ("slip_correct", "f1"):
        known = [row for row in settings if row[figure] is not None]
        top = max(known, key=lambda row: row[figure], default=None)
        best |= {f"most_{figure}": top and top["setting"], f"{figure}_of_it": top and top[figure]}
    return {"models": len(scores), "settings": len(settings), "trajectories": scores[0]["trajectories"], **best}


def _values(scores: Iterable[dict[str, Any]], key: str) -> list[float]:
    """A figure of several scores, those left out where it does not exist: an object that never slips has no timing."""
    return [float(score[key]) for score in scores if score[key] is not None]


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _sd(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _draw(figure: Any, outcome: Outcome) -> None:
    """Bars of timing and F1 with the paper's figures, and below, for each setting, the CDF of t_m - t_c."""
    settings = _settings(outcome.rows)
    rows = -(-len(settings) // PANELS)
    above, below = figure.subfigures(2, 1, height_ratios=[1.2 + 0.42 * len(settings), 3.1 * rows])
    timing, f1 = above.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    above.suptitle("Slip timing and F1, mean and sd over objects and seeds" + _simulated(outcome), fontsize=12)
    at = np.arange(len(settings), dtype=float)
    looks = (
        ("slip_early", "too early", picture.EARLY),
        ("slip_correct", "correct", picture.CORRECT),
        ("slip_late", "too late", picture.LATE),
    )
    for place, (key, label, colour) in enumerate(looks):
        lengths = [row[key] or 0.0 for row in settings]
        errors = [row["slip_correct_sd"] or 0.0 for row in settings] if key == "slip_correct" else None
        timing.barh(at + 0.27 * (place - 1), lengths, 0.25, xerr=errors, color=colour, label=label)
    errors = [row["f1_sd"] or 0.0 for row in settings]
    f1.barh(at, [row["f1"] or 0.0 for row in settings], 0.5, xerr=errors, color=picture.CORRECT)
    for axes, key, title in ((timing, "slip_correct", "share of trajectories"), (f1, "f1", "F1")):
        told = [(row[f"paper_{key}"], y) for row, y in zip(settings, at, strict=True)]
        told = [pair for pair in told if pair[0] is not None]
        axes.plot([x for x, _ in told], [y for _, y in told], label="the paper", **picture.PAPER)
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

    Why so: the plain share of trajectories, where the paper smooths with a Gaussian kernel. A detection that is far
    too early, which all models know, would make its width as large as what is to be seen.
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
    axes.axvspan(slip.EARLIEST_MS, slip.LATEST_MS, color=picture.CORRECT, alpha=0.08)
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlim=SHOWN_MS, ylim=(-0.08, 1.02), xlabel="t_m - t_c [ms]")
    axes.set_title(textwrap.fill(title, TITLE_WIDTH, break_on_hyphens=False), fontsize=8)


def _simulated(outcome: Outcome) -> str:
    return " (simulated)" if outcome.simulated else ""
