"""The part `sim` of `evaluate cost`: error against run time of the simulated gel and camera."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from evetac_cli.commands.evaluate import EvaluateCost
from evetac_cli.evaluate.cost import camera as camera_cost
from evetac_cli.evaluate.cost import gel as gel_cost
from evetac_cli.evaluate.cost import unloading
from evetac_cli.evaluate.rows import collect
from evetac_cli.jobs import Progress, Rows

# Errors in the plot, for the rows that have them.
ERRORS = (
    "error_um_object_rms",
    "error_um_gel_rms",
    "error_ms_gross_slip",
    "error_ms_last_stuck_node",
    "error_um_before",
    "error_um_after",
    "error_us_median",
    "error_us_p95",
    "error_share_count",
)


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return rows of the gel's mechanics, with constant and with falling friction, and of the cameras."""
    loads = camera_cost.workloads()
    rows = chain(
        gel_cost.mechanics_rows(params.seed, params.full),
        unloading.unloading_rows(params.seed, params.full, params.trials),
        camera_cost.camera_rows(params.seed, loads),
    )
    total = gel_cost.row_count(params.full) + unloading.row_count(params.full) + camera_cost.row_count(loads)
    return collect(rows, total, progress)


def summary(rows: Rows) -> dict[str, Any]:
    """Return the reference's own error, the explicit steps that blow up, and the gain of the implicit step.

    implicit_saves_times: run time of the most accurate explicit integration over that of the cheapest implicit one that
    is at least as accurate, by the object's position.
    """
    mechanics = [row for row in rows if row["part"] == gel_cost.PART]
    (reference,) = (row for row in mechanics if row["setting"].startswith("reference"))
    explicit = [row for row in mechanics if row["setting"].startswith("explicit")]
    blown_up = [row for row in explicit if row["outcome"].startswith("blew up")]
    stable = [row for row in explicit if row["error_um_object_rms"] is not None]
    best = min(stable, key=lambda row: row["error_um_object_rms"], default=None)
    saved = None
    if best:
        implicit = (row for row in mechanics if row["setting"].startswith("theta"))
        enough = [row for row in implicit if row["error_um_object_rms"] <= best["error_um_object_rms"]]
        saved = max((best["time_us_median"] / row["time_us_median"] for row in enough), default=None)
    return {
        "rows": len(rows),
        "reference_um_object_at_most": reference["error_um_object_rms"],
        "reference_um_gel_at_most": reference["error_um_gel_rms"],
        "explicit_blows_up_at": ", ".join(row["setting"].removeprefix("explicit, dt ") for row in blown_up) or None,
        "implicit_saves_times": saved,
    }
