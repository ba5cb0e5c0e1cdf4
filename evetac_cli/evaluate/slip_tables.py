"""The tables of a report on slip: timing, F1 and warnings by setting, object, sensor, model and trajectory.

Every share of slips is over `counted` trajectories. Its row also counts those that are left out: `abstained`, whose
labels cannot determine the onset, and `no_slip`. F1 and false alarms are over the slices of all trajectories, without
the interval of an uncertain onset.

Trajectories of an object are alike, so intervals come from resampling objects (and sensors, for timing); those of one
object's row from resampling its trajectories. Seeds of training are averaged first.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.evaluate import paper, slip_over_time, slip_warnings
from evetac_cli.evaluate.slip_models import Model
from evetac_cli.evaluate.slip_warnings import Judged
from evetac_cli.evaluate.source import TRUTH
from evetac_cli.jobs import Rows
from evetac_cli.kernels import estimates
from evetac_cli.kernels.slip import metrics
from evetac_cli.kernels.slip.metrics import Prediction

# Names and bounds of t_m - t_c in ms, both included: the intervals of the paper's "Evaluating Slip Timing".
TIMING_BINS = (
    ("over_50_ms_ahead", -np.inf, metrics.EARLIEST_MS - 1),
    ("50_to_31_ms_ahead", metrics.EARLIEST_MS, -31),
    ("30_to_11_ms_ahead", -30, -11),
    ("10_to_0_ms_ahead", -10, 0),
    ("1_to_20_ms_after", 1, metrics.LATEST_MS),
    ("over_20_ms_after", metrics.LATEST_MS + 1, np.inf),
)


COUNTS = {"trajectories": "trajectories", "counted": "slips", "abstained": "abstained", "no_slip": "no_slip"}
OF_GROUP = ("slip_early", "slip_correct", "slip_late", "f1")
TRUE_SLIP_SHARE = "true slip share"  # in the name of a setting that also learned this
ALWAYS = ("model", "truth")  # traits that are always part of a setting's name


def group_by_setting(models: Sequence[Model]) -> dict[str, list[int]]:
    """Return name of each setting -> indices of its models; names contain the traits in which settings differ."""
    groups: dict[str, list[int]] = {}
    for index, model in enumerate(models):
        groups.setdefault(model.setting, []).append(index)
    traits = [_traits(models[members[0]]) for members in groups.values()]
    varying = [key for key in traits[0] if len({trait[key] for trait in traits}) > 1]
    by_name: dict[str, list[int]] = {}
    for trait, members in zip(traits, groups.values(), strict=True):
        name = ", ".join(trait[key] for key in trait if (key in varying or key in ALWAYS) and trait[key])
        while name in by_name:
            name += "'"  # differs only in its training files
        by_name[name] = members
    return by_name


def _traits(model: Model) -> dict[str, str]:
    parameters = model.header["parameters"]
    return {
        "model": model.architecture.name,
        "horizon": f"{model.horizon_ms} ms ahead" if model.horizon_ms else "",
        "preset": str(parameters.get("preset", "")),
        "truth": TRUE_SLIP_SHARE if model.learned_true_slip_share else "",
        "labels": f"labels {model.labels}",
        "steps": f"up to {parameters.get('max_steps')} steps",
        "epochs": f"{parameters.get('epochs')} epochs",
        "trained_on": f"{parameters.get('trained_on')} trajectories",
        "scenes": f"scenes {model.scenes}",
        "folds": f"{parameters['folds']} folds" if parameters.get("folds") else "",
    }


def tables(
    models: Sequence[Model],
    thresholds: Sequence[float],
    predictions: Sequence[list[Prediction]],
    paths: Sequence[Path],
    *,
    doubts: Mapping[Path, str],
    judged_by: str,
) -> tuple[Rows, dict[str, Any]]:
    """Return all rows and a summary.

    predictions: for each model, one per path. doubts: why labels abstain. judged_by: where the onsets come from, LABELS
    or TRUTH; the paper's figures are only for those of labels.
    """
    scores = [metrics.score(of_model, at) for of_model, at in zip(predictions, thresholds, strict=True)]
    settings: Rows = []
    timing_bins: Rows = []
    objects: Rows = []
    sensors: Rows = []
    steps: Rows = []  # bins of probability
    over_time: Rows = []
    judged = [
        [Judged.of(prediction, at) for prediction in of_model]
        for of_model, at in zip(predictions, thresholds, strict=True)
    ]
    for setting, members in group_by_setting(models).items():
        first = models[members[0]]
        cells, of_sensors = (
            [by_group(predictions[index], thresholds[index], factor) for index in members]
            for factor in ("object", "sensor")
        )
        late_by = [
            (prediction.object, _late_by(prediction, thresholds[index]))
            for index in members
            for prediction in predictions[index]
            if prediction.onset >= 0 and prediction.timed
        ]
        seeds, of_seeds = [judged[index] for index in members], [predictions[index] for index in members]
        settings.append(setting_row(setting, first, cells) | slip_warnings.columns(seeds, of_seeds) | _f1_ends(cells))
        over_time += slip_over_time.rows(setting, of_seeds, [thresholds[index] for index in members])
        sensors += [
            {
                "setting": setting,
                "sensor": name,
                **_counts(score),
                **{figure: _mean(_values([one[name] for one in of_sensors], figure)) for figure in OF_GROUP},
                **slip_warnings.group(seeds, "sensor", name),
            }
            for name, score in of_sensors[0].items()
        ]
        steps += slip_warnings.reliability_rows(setting, of_seeds)
        timing_bins.append({"setting": setting, **_timing_bins(late_by), **_paper_timing_bins(first, set(cells[0]))})
        for name in cells[0]:
            of_object = [cell[name] for cell in cells]
            correct, f1 = _values(of_object, "slip_correct"), _values(of_object, "f1")
            objects.append(
                {
                    "setting": setting,
                    "object": name,
                    **_counts(of_object[0]),
                    "slip_early": _mean(_values(of_object, "slip_early")),
                    "slip_correct": _mean(correct),
                    "slip_correct_sd_seeds": _sd(correct),
                    "slip_late": _mean(_values(of_object, "slip_late")),
                    "f1": _mean(f1),
                    "f1_sd_seeds": _sd(f1),
                    **slip_warnings.group(seeds, "object", name),
                    **_papers_object(first, name, len(members)),
                }
            )
    by_model = [
        {"setting": setting, "file": models[index].path.name, "seed": _seed(models[index]), **scores[index]}
        for setting, members in group_by_setting(models).items()
        for index in members
    ]
    trajectories = [
        _trajectory_row(setting, models[index], thresholds[index], prediction, path)
        | {"abstained_because": doubts.get(path), **_of_judged(one)}
        for setting, members in group_by_setting(models).items()
        for index in members
        for prediction, one, path in zip(predictions[index], judged[index], paths, strict=True)
    ]
    tables_ = [*settings, *timing_bins, *steps, *over_time, *objects, *sensors, *by_model, *trajectories]
    for row in tables_:
        row["judged_by"] = judged_by
        if judged_by == TRUTH:
            row.update(dict.fromkeys(name for name in row if name.startswith("paper_")))
    return tables_, {**_summary(scores, settings), "judged_by": judged_by}


def _counts(score: dict[str, Any]) -> dict[str, int]:
    """Return how many trajectories are behind shares of slips, and how many are left out."""
    return {name: score[key] for name, key in COUNTS.items()}


def _papers_object(model: Model, name: str, models: int) -> dict[str, Any]:
    """Return the model's columns in an object's row, with the paper's timing on objects 12 and 15.

    The paper's detector often fails on these two. None where it has no figure, and for objects seen in training.
    """
    parameters = model.header["parameters"]
    architecture = model.architecture.name
    seen = name in model.objects
    return {
        "model": architecture,
        "horizon_ms": model.horizon_ms,
        "preset": parameters.get("preset"),
        "models": models,
        "paper_slip_correct_of_object": None
        if seen
        else paper.value("correct", "object", architecture, model.horizon_ms, name),
    }


def _of_judged(one: Judged) -> dict[str, Any]:
    return {"sensor_name": one.sensor, "lead_ms": one.lead_ms, "false_alarms": one.false_alarms}


def _seed(model: Model) -> int | None:
    seed: int | None = model.header["parameters"].get("seed")
    return seed


def by_group(predictions: Sequence[Prediction], threshold: float, factor: str) -> dict[str, dict[str, Any]]:
    """Return the score of one model on the trajectories of each object or each sensor (factor)."""
    groups: dict[str, list[Prediction]] = {}
    for prediction in predictions:
        groups.setdefault(getattr(prediction, factor), []).append(prediction)
    return {name: metrics.score(members, threshold) for name, members in groups.items()}


def _late_by(prediction: Prediction, threshold: float) -> int | None:
    """Return t_m - t_c in ms; None if nothing was detected."""
    first = metrics.onset(prediction.detected(threshold))
    return first - prediction.onset if first >= 0 else None


def setting_row(setting: str, model: Model, cells: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a setting's figures, means over objects and seeds, next to the paper's.

    `cells`: for every seed, the score of every object. *_sd is over objects and seeds; *_sd_seeds is over the means
    over objects of each seed.
    """
    every = [score for cell in cells for score in cell.values()]
    parameters = model.header["parameters"]
    row: dict[str, Any] = {
        "setting": setting,
        "model": model.architecture.name,
        "horizon_ms": model.horizon_ms,
        "preset": parameters.get("preset"),
        "labels": model.labels,
        "true_slip_share": model.learned_true_slip_share,
        "scenes": model.scenes,
        "max_steps": parameters.get("max_steps"),
        "folds": parameters.get("folds", 0),
        "seeds": len(cells),
        **{name: sum(score[key] for score in cells[0].values()) for name, key in COUNTS.items()},
        "objects_counted": sum(score["slips"] > 0 for score in cells[0].values()),
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
    """Return the paper's figures for the same model, on objects seen or not seen in training; None where it has none.

    Models on the 6 x 6 images for a CPU are compared with the paper's full images.
    """
    name = model.architecture.name.removesuffix("-6x6")
    figures: dict[str, Any] = {"paper_slip_correct": None, "paper_f1": None}
    if "unknown" in objects:
        return figures
    if objects <= model.objects:
        seen_key = ("known", name, model.horizon_ms)
        figures = {"paper_slip_correct": paper.value("correct", *seen_key), "paper_f1": paper.value("f1", *seen_key)}
    elif not objects & model.objects:
        figures["paper_slip_correct"] = paper.value("correct", "unseen", name, model.horizon_ms)
    return figures


def _f1_ends(cells: list[dict[str, Any]]) -> dict[str, float | None]:
    """Return the ends of F1's interval, from resampling objects; `cells`: for every seed, the score of every object."""
    of_objects = [_mean(_values([cell[name] for cell in cells], "f1")) for name in cells[0]]
    known = np.array([value for value in of_objects if value is not None])
    weights = estimates.cluster_weights(range(len(known))) if len(known) > 1 else None
    f1 = None if weights is None else estimates.ratio_of_clusters(known, np.ones(len(known)), weights)
    return {"f1_low": None, "f1_high": None} if f1 is None else {"f1_low": f1.low, "f1_high": f1.high}


def _timing_bins(late_by: Sequence[tuple[str, int | None]]) -> dict[str, Any]:
    """Return shares of trajectories with an onset by bins of t_m - t_c, and the median of those with a detection.

    late_by: object and t_m - t_c of each trajectory and seed.
    """
    detected = [value for _, value in late_by if value is not None]
    inside = {
        name: np.array([value is not None and low <= value <= high for _, value in late_by], np.float64)
        for name, low, high in TIMING_BINS
    } | {"never_detected": np.array([value is None for _, value in late_by], np.float64)}
    row: dict[str, Any] = {
        "pairs_counted": len(late_by),
        "t_m_minus_t_c_ms_median": float(np.median(detected)) if detected else None,
    }
    row |= {name: float(one.mean()) if len(one) else None for name, one in inside.items()}
    weights = estimates.cluster_weights([name for name, _ in late_by])
    for name, one in inside.items():
        share = estimates.ratio_of_clusters(one, np.ones(len(one)), weights)
        row |= {f"{name}_low": share and share.low, f"{name}_high": share and share.high}
    return row


def _paper_timing_bins(model: Model, objects: set[str]) -> dict[str, Any]:
    unseen = not objects & (model.objects | {"unknown"})
    share = paper.value("10_to_0_ms_ahead", "unseen", model.architecture.name, model.horizon_ms)
    return {"paper_10_to_0_ms_ahead": share if unseen else None}


def _trajectory_row(setting: str, model: Model, threshold: float, prediction: Prediction, path: Path) -> dict[str, Any]:
    first = metrics.onset(prediction.detected(threshold))
    labelled = prediction.onset >= 0 and prediction.timed
    return {
        "setting": setting,
        "model_file": model.path.name,
        "file": path.name,
        "object": prediction.object,
        "t_c_ms": prediction.onset if labelled else None,
        "t_m_ms": first if first >= 0 else None,
        "t_m_minus_t_c_ms": first - prediction.onset if labelled and first >= 0 else None,
        "timing": metrics.timing(first, prediction.onset) if labelled else None,
        "abstained": not prediction.timed,
        "f1": prediction.counts(threshold).f1,
    }


def _summary(scores: Rows, settings: Rows) -> dict[str, Any]:
    """Return the score of a single model; for several models, the best settings."""
    if len(scores) == 1:
        return scores[0]
    best: dict[str, Any] = {}
    for figure in ("slip_correct", "f1"):
        scored = [row for row in settings if row[figure] is not None]
        top = max(scored, key=lambda row: row[figure], default=None)
        best |= {f"best_{figure}_setting": top and top["setting"], f"best_{figure}": top and top[figure]}
    return {"models": len(scores), "settings": len(settings), **_counts(scores[0]), **best}


def _values(scores: Iterable[dict[str, Any]], key: str) -> list[float]:
    """Return one figure of several scores, without missing ones: an object that never slips has no timing."""
    return [float(score[key]) for score in scores if score[key] is not None]


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _sd(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None
