"""Define the tables of slip detection by time and by object: first detections, timing by object, predictions over time.

They come from the same reports of `evaluate slip` as the table of the paper's recipe. The paper shows the first two for
`fast-slow` trained 10 ms ahead, on unseen objects, and the third for one trajectory of object 3.
"""

import numpy as np

from evetac_cli.evaluate.common.rows import mean
from evetac_cli.evaluate.slip.tables import TIMING_BINS
from evetac_cli.evaluate.subject import grouped
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels import estimates
from scripts.paper.rows import BY_UNIT
from scripts.reproduce.tables import Column, Evaluations, Table, having

MODEL, HORIZON_MS = "fast-slow", 10  # whose first detections the paper shows
KNOWN, UNSEEN = "recipe-known", "recipe-unseen"
ALL = "all"  # in the column `object` of a row over all objects
# Bins of t_m - t_c in words, and the last one, which has no end.
BIN_WORDS = {
    "over_50_ms_ahead": "before -50 ms",
    "50_to_31_ms_ahead": "-50 to -31 ms",
    "30_to_11_ms_ahead": "-30 to -11 ms",
    "10_to_0_ms_ahead": "-10 to 0 ms",
    "1_to_20_ms_after": "1 to 20 ms",
    "over_20_ms_after": "after 20 ms",
}


def setting_of(evaluations: Evaluations, model: str, horizon_ms: int) -> Row | None:
    """Return the row of the setting of a network and horizon; None if it was not trained."""
    settings = having(evaluations, "setting", "seeds")
    return next((row for row in settings if (row["model"], row["horizon_ms"]) == (model, horizon_ms)), None)


def timing_rows(evaluations: Evaluations) -> Rows:
    """Return the share of first detections in each bin, and up to its end, over all objects and by object.

    Slips that are never detected are in no bin, so the last cumulative share may be below 1. Intervals come from
    resampling objects, and for one object from resampling its trajectories; seeds are averaged first.
    """
    setting = setting_of(evaluations, MODEL, HORIZON_MS)
    if setting is None:
        return []
    own = [row for row in having(evaluations, "t_c_ms", "t_m_minus_t_c_ms") if row["setting"] == setting["setting"]]
    slips = [row for row in own if row["t_c_ms"] is not None]
    what = {key: setting[key] for key in ("setting", "model", "horizon_ms", "preset", "seeds", "trajectories")}
    rows = []
    for name in (ALL, *sorted({row["object"] for row in slips}, key=int)):
        members = [row for row in slips if name in (ALL, row["object"])]
        files = [(row["object"], row["file"]) for row in members]
        factor = [row["object"] for row in members] if name == ALL else files
        weights, ones, cumulative = estimates.cluster_weights(factor), np.ones(len(members)), 0.0
        for bin_, low, high in TIMING_BINS:
            hits = np.array([_is_within(row["t_m_minus_t_c_ms"], low, high) for row in members], np.float64)
            share = estimates.ratio_of_clusters(hits, ones, weights)
            assert share is not None  # there are members
            cumulative += share.value
            rows.append(
                {
                    **what,
                    "object": name,
                    "bin": bin_,
                    "bin_words": BIN_WORDS[bin_],
                    "slips": len(set(files)),
                    "share": share.value,
                    "share_low": share.low,
                    "share_high": share.high,
                    "by_its_end": cumulative,
                    "paper_timing_share": setting_share(bin_, name),
                }
            )
    return rows


def setting_share(bin_: str, object_: str) -> float | None:
    """Return the paper's share of first detections in a bin, over all objects; None if it has none."""
    from evetac_cli.evaluate import PAPER

    return PAPER.value(bin_, "unseen", MODEL, HORIZON_MS) if object_ == ALL else None


def _is_within(late_by_ms: int | None, low: float, high: float) -> bool:
    return late_by_ms is not None and low <= late_by_ms <= high


def slip_object_rows(evaluations: Evaluations) -> Rows:
    """Return timing and F1 of each network on each object."""
    rows = having(evaluations, "setting", "object", "slip_correct_sd_seeds", "trajectories")
    return sorted((row for row in rows if "seeds" not in row), key=lambda row: int(row["object"]))


def over_time_rows(evaluations: Evaluations) -> Rows:
    """Return the predictions over time of the networks that do not predict ahead, means over objects."""
    settings = {row["setting"]: row for row in having(evaluations, "setting", "seeds") if not row["horizon_ms"]}
    what = ("model", "horizon_ms", "preset", "seeds")
    known = [row for row in having(evaluations, "after_onset_ms") if row["setting"] in settings and row["predictions"]]
    rows = []
    for of_objects in grouped(known, ("setting", "after_onset_ms")):
        by_object = {row["object"]: {"detected_share": row["detected_share"]} for row in of_objects}
        means = {key: mean(row[key] for row in of_objects) for key in ("probability_mean", "detected_share")}
        first, count = of_objects[0], sum(row["predictions"] for row in of_objects)
        setting = {key: settings[first["setting"]][key] for key in what}
        counts = {"predictions": count, "objects": len(by_object), BY_UNIT: by_object}
        rows.append({**setting, "after_onset_ms": first["after_onset_ms"], **counts, **means})
    return rows


SLIP_TIMING = Table(
    "slip-timing",
    f"First detections by `{MODEL}`, {HORIZON_MS} ms ahead, trained by the paper's recipe, on {{recordings}}"
    " trajectories of objects {objects}: share by time relative to the onset in the labels, share by the end of it",
    (UNSEEN,),
    timing_rows,
    (Column("object", "{object}"), Column("slips", "{slips}")),
    across=Column("{bin_words} (paper)", "{share:.2f}; {by_its_end:.2f}", "{paper_timing_share:.2f}"),
    notes=("Means over the seeds of training. Slips that were never detected are in no column.",),
)

SLIP_BY_OBJECT = Table(
    "slip-by-object",
    "Timing correct by object, networks trained by the paper's recipe, {recordings} trajectories of objects {objects}",
    (UNSEEN,),
    slip_object_rows,
    (Column("object", "{object}"), Column("trajectories", "{trajectories}")),
    across=Column("{setting} (paper)", "{slip_correct:.2f}", "{paper_slip_correct_of_object:.2f}"),
    notes=("The paper gives figures by object for the two objects on which its detector often fails.",),
)

SLIP_OVER_TIME = Table(
    "slip-over-time",
    "Predictions over time about the onset in the labels, objects {objects}: mean probability of slip, share of"
    " trajectories and seeds above the network's threshold, and their number",
    (KNOWN,),
    over_time_rows,
    (Column("network", "{model}"), Column("seeds", "{seeds}")),
    across=Column("{after_onset_ms:+d} ms", "{probability_mean:.2f}, {detected_share:.0%} of {predictions}"),
    notes=("The paper shows a single trajectory, of object 3. Labels end 20 ms after the onset; predictions go on.",),
)

TABLES = (SLIP_TIMING, SLIP_BY_OBJECT, SLIP_OVER_TIME)
