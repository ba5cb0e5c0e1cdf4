"""The tables of a report on slip: timing, F1 and warnings by setting, object, sensor, model and trajectory.

Every share of slips is over `counted` trajectories. Its row also counts those that are left out: `abstained`, whose
labels cannot determine the onset, and `no_slip`. F1 and false alarms are over the slices of all trajectories, without
the interval of an uncertain onset.

Trajectories of an object are alike, so intervals come from resampling objects (and sensors, for timing); those of one
object's row from resampling its trajectories. Seeds of training are averaged first.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from evetac_cli.evaluate.common.marks import TRUTH
from evetac_cli.evaluate.common.rows import ends, mean, quantile, resampled, sd
from evetac_cli.evaluate.slip import PAPER
from evetac_cli.evaluate.slip import warnings as slip_warnings
from evetac_cli.evaluate.slip.models import Model
from evetac_cli.evaluate.slip.warnings import Judged
from evetac_cli.jobs import Row, Rows
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
OF_SETTING = ("slip_correct", "f1")  # with a standard deviation
TABLES = ("settings", "timing", "reliability", "over time", "objects", "sensors", "models", "trajectories")
TIMES_MS = range(-20, 61, 5)  # about the onset; the paper's range
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
) -> tuple[Rows, Row]:
    """Return all rows and a summary.

    predictions: for each model, one per path. doubts: why labels abstain. judged_by: where the onsets come from, LABELS
    or TRUTH; the paper's figures are only for those of labels.
    """
    scores = [metrics.score(of_model, at) for of_model, at in zip(predictions, thresholds, strict=True)]
    judged = [
        [Judged.of(prediction, at) for prediction in of_model]
        for of_model, at in zip(predictions, thresholds, strict=True)
    ]
    found: dict[str, Rows] = {name: [] for name in TABLES}
    for setting, members in group_by_setting(models).items():
        first = models[members[0]]
        own, ats = [predictions[index] for index in members], [thresholds[index] for index in members]
        seeds = [judged[index] for index in members]
        cells, of_sensors = (
            [by_group(of_seed, at, factor) for of_seed, at in zip(own, ats, strict=True)]
            for factor in ("object", "sensor")
        )
        f1 = resampled(mean(cell[name]["f1"] for cell in cells) for name in cells[0])
        row = setting_row(setting, first, cells) | slip_warnings.columns(seeds, own) | ends("f1", f1)
        found["settings"].append(row)
        found["timing"].append({"setting": setting, **_timing_bins(own, ats), **_paper_timing(first, set(cells[0]))})
        found["reliability"] += slip_warnings.reliability_rows(setting, own)
        found["over time"] += over_time_rows(setting, own, ats)
        for name in cells[0]:
            row = {"setting": setting, "object": name, **_group_columns([cell[name] for cell in cells], with_sd=True)}
            row |= slip_warnings.group(seeds, "object", name)
            found["objects"].append(row | _papers_object(first, name, len(members)))
        for name in of_sensors[0]:
            row = {"setting": setting, "sensor": name, **_group_columns([one[name] for one in of_sensors])}
            found["sensors"].append(row | slip_warnings.group(seeds, "sensor", name))
        for index in members:
            model = models[index]
            about = {"file": model.path.name, "seed": model.header["parameters"].get("seed")}
            found["models"].append({"setting": setting, **about, **scores[index]})
            found["trajectories"] += [
                _trajectory_row(setting, model, thresholds[index], prediction, path)
                | {"abstained_because": doubts.get(path), "sensor_name": one.sensor}
                | {"lead_ms": one.lead_ms, "false_alarms": one.false_alarms}
                for prediction, one, path in zip(predictions[index], judged[index], paths, strict=True)
            ]
    rows = [row for table in found.values() for row in table]
    for row in rows:
        row["judged_by"] = judged_by
        if judged_by == TRUTH:
            row.update(dict.fromkeys(name for name in row if name.startswith("paper_")))
    return rows, {**_summary(scores, found["settings"]), "judged_by": judged_by}


def _group_columns(scores: Sequence[Row], *, with_sd: bool = False) -> Row:
    """Return the columns of an object or a sensor from its score for every seed."""
    row: Row = _counts(scores[0])
    for figure in OF_GROUP:
        row[figure] = mean(score[figure] for score in scores)
        if with_sd and figure in OF_SETTING:
            row[f"{figure}_sd_seeds"] = sd(score[figure] for score in scores)
    return row


def _counts(score: Row) -> Row:
    """Return how many trajectories are behind shares of slips, and how many are left out."""
    return {name: score[key] for name, key in COUNTS.items()}


def _papers_object(model: Model, name: str, models: int) -> Row:
    """Return the model's columns in an object's row, with the paper's timing on objects 12 and 15.

    The paper's detector often fails on these two. None where it has no figure, and for objects seen in training.
    """
    key = ("correct", "object", model.architecture.name, model.horizon_ms, name)
    return {
        "model": model.architecture.name,
        "horizon_ms": model.horizon_ms,
        "preset": model.header["parameters"].get("preset"),
        "models": models,
        "paper_slip_correct_of_object": None if name in model.objects else PAPER.value(*key),
    }


def by_group(predictions: Sequence[Prediction], threshold: float, factor: str) -> dict[str, Row]:
    """Return the score of one model on the trajectories of each object or each sensor (factor)."""
    groups: dict[str, list[Prediction]] = {}
    for prediction in predictions:
        groups.setdefault(getattr(prediction, factor), []).append(prediction)
    return {name: metrics.score(members, threshold) for name, members in groups.items()}


def setting_row(setting: str, model: Model, cells: list[Row]) -> Row:
    """Return a setting's figures, means over objects and seeds, next to the paper's.

    `cells`: for every seed, the score of every object. *_sd is over objects and seeds; *_sd_seeds is over the means
    over objects of each seed.
    """
    every = [score for cell in cells for score in cell.values()]
    parameters = model.header["parameters"]
    row: Row = {
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
        "slip_early": mean(score["slip_early"] for score in every),
        "slip_late": mean(score["slip_late"] for score in every),
    }
    for figure in OF_SETTING:
        row[figure] = mean(score[figure] for score in every)
        row[f"{figure}_sd"] = sd(score[figure] for score in every)
        row[f"{figure}_sd_seeds"] = sd(mean(score[figure] for score in cell.values()) for cell in cells)
    return row | _paper(model, set(cells[0]))


def _paper(model: Model, objects: set[str]) -> Row:
    """Return the paper's figures for the same model, on objects seen or not seen in training; None where it has none.

    Models on the 6 x 6 images for a CPU are compared with the paper's full images.
    """
    name = model.architecture.name.removesuffix("-6x6")
    figures: Row = {"paper_slip_correct": None, "paper_f1": None}
    if "unknown" in objects:
        return figures
    if objects <= model.objects:
        seen_key = ("known", name, model.horizon_ms)
        figures = {"paper_slip_correct": PAPER.value("correct", *seen_key), "paper_f1": PAPER.value("f1", *seen_key)}
    elif not objects & model.objects:
        figures["paper_slip_correct"] = PAPER.value("correct", "unseen", name, model.horizon_ms)
    return figures


def _timing_bins(predictions: Sequence[Sequence[Prediction]], thresholds: Sequence[float]) -> Row:
    """Return shares of trajectories with an onset by bins of t_m - t_c, and the median of those with a detection."""
    objects: list[str] = []
    late_by: list[float] = []  # of each trajectory and seed; NaN if nothing was detected
    for of_seed, threshold in zip(predictions, thresholds, strict=True):
        for prediction in of_seed:
            if prediction.onset >= 0 and prediction.timed:
                first = metrics.onset(prediction.detected(threshold))
                objects.append(prediction.object)
                late_by.append(first - prediction.onset if first >= 0 else np.nan)
    late = np.array(late_by, np.float64)
    inside = {name: ((late >= low) & (late <= high)).astype(np.float64) for name, low, high in TIMING_BINS}
    inside["never_detected"] = np.isnan(late).astype(np.float64)
    row: Row = {"pairs_counted": len(late), "t_m_minus_t_c_ms_median": quantile(late_by)}
    row |= {name: mean(one) for name, one in inside.items()}
    weights = estimates.cluster_weights(objects)
    for name, one in inside.items():
        row |= ends(name, estimates.ratio_of_clusters(one, np.ones(len(one)), weights))
    return row


def _paper_timing(model: Model, objects: set[str]) -> Row:
    unseen = not objects & (model.objects | {"unknown"})
    share = PAPER.value("10_to_0_ms_ahead", "unseen", model.architecture.name, model.horizon_ms)
    return {"paper_10_to_0_ms_ahead": share if unseen else None}


def _trajectory_row(setting: str, model: Model, threshold: float, prediction: Prediction, path: Path) -> Row:
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


def _summary(scores: Rows, settings: Rows) -> Row:
    """Return the score of a single model; for several models, the best settings."""
    if len(scores) == 1:
        return scores[0]
    best: Row = {}
    for figure in ("slip_correct", "f1"):
        scored = [row for row in settings if row[figure] is not None]
        top = max(scored, key=lambda row: row[figure], default=None)
        best |= {f"best_{figure}_setting": top and top["setting"], f"best_{figure}": top and top[figure]}
    return {"models": len(scores), "settings": len(settings), **_counts(scores[0]), **best}


def over_time_rows(setting: str, predictions: Sequence[Sequence[Prediction]], thresholds: Sequence[float]) -> Rows:
    """Return a row per object and time about the onset of slip (paper, figure of predictions over time).

    The paper shows one trajectory of object 3. Here every slip counts: the mean probability, and the share of slips
    whose probability reaches the threshold. predictions: for each model of the setting, one per trajectory.

    The column `predictions` counts trajectories and seeds with a probability at that time: recordings may end earlier.
    """
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for of_model, threshold in zip(predictions, thresholds, strict=True):
        for prediction in of_model:
            if prediction.onset < 0 or not prediction.timed:
                continue
            slices = prediction.onset + np.array(TIMES_MS)
            inside = (slices >= 0) & (slices < len(prediction.probability))
            probability, reached = np.full(len(slices), np.nan), np.full(len(slices), np.nan)
            probability[inside] = prediction.probability[slices[inside]]
            reached[inside] = prediction.detected(threshold)[slices[inside]]
            found.setdefault(prediction.object, []).append((probability, reached))
    return [
        {
            "setting": setting,
            "object": name,
            "after_onset_ms": after_ms,
            "predictions": int(known.sum()),
            "probability_mean": float(np.mean(probability[known])) if known.any() else None,
            "detected_share": float(np.mean(reached[known])) if known.any() else None,
        }
        for name, pairs in found.items()
        for probabilities, detections in [(np.stack([one for one, _ in pairs]), np.stack([two for _, two in pairs]))]
        for after_ms, probability, reached in zip(TIMES_MS, probabilities.T, detections.T, strict=True)
        for known in [~np.isnan(probability)]
    ]
