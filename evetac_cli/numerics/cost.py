"""evaluate cost: error against run time of a part's numerical choices, as rows and as a picture beside the report.

Run times are those of the machine and the moment, so the same recipe gives other figures elsewhere. A report that
exists is kept: delete it to measure again.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.numerics import tracker_cost
from evetac_cli.numerics.simulator import camera_cost, gel_cost
from evetac_cli.params import EvaluateCost, recipe_of
from evetac_cli.stages.evaluate import Rows, own_report, picture, report

OUTPUT = "report"
METHOD = 1
REAL_TIME_US = 1000.0  # run time of a simulated millisecond, at real time
UNITS = ("um", "us", "px", "ms")


def jobs(files: list[Path], params: EvaluateCost, out: Path | None) -> list[Job]:
    """One report on the part: `<part>.cost.report.h5`, in the present folder if no other is given."""
    if params.part == "model":
        from evetac_cli.numerics import model_cost

        return model_cost.jobs(files, params, out)
    if params.part == "grasp" and not files:
        from evetac_cli.numerics import grasp_cost

        return grasp_cost.jobs(params, out)
    if files or params.model:
        raise InputError("only the part model is measured on files", where="evaluate cost", found=f"part {params.part}")
    return [Job((), own_report(params.part, "cost", out))]


def run(job: Job, params: EvaluateCost, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every setting; the picture is drawn again where it is missing."""
    if params.part == "model":
        from evetac_cli.numerics import model_cost

        return model_cost.run(job, params, force=force, progress=progress)
    if params.part == "grasp":
        from evetac_cli.numerics import grasp_cost

        return grasp_cost.run(job, params, force=force, progress=progress)

    def measure() -> tuple[Rows, dict[str, Any]]:
        if params.part == "label":
            return _measure_label(params, progress)
        if params.part == "track":
            return _measure_track(params, progress)
        extent = gel_cost.FULL if params.full else gel_cost.USUAL
        rows: Rows = []
        for row in gel_cost.mechanics_cost(params.seed, extent):
            rows.append(row)
            progress(len(rows), extent.rows + 1)
        rows += camera_cost.camera_cost(params.seed)
        progress(extent.rows + 1, extent.rows + 1)
        return rows, _summary(rows)

    outcome = report(job, "evaluate cost", METHOD, recipe_of(params), [], measure, force=force, simulated_source=True)
    plot = job.output.with_suffix(".png")
    if outcome.made or not plot.exists():
        drawn = _draw(outcome.rows, plot)
        shown = str(plot) if drawn else "none: needs matplotlib, pip install 'evetac[plot]'"
        outcome = dataclasses.replace(outcome, summary={**outcome.summary, "plot": shown})
    return outcome


def _measure_label(params: EvaluateCost, progress: Progress) -> tuple[Rows, dict[str, Any]]:
    """Rows of the methods of labelling, and how many times faster than the plain per-millisecond method each is."""
    from evetac_cli.numerics import label_cost

    rows: Rows = []
    total = len(label_cost.methods())
    for row in label_cost.label_cost(params.seed, label_cost.FULL if params.full else label_cost.USUAL):
        rows.append(row)
        progress(len(rows), total)
    plain_us = rows[0]["time_us_median"]
    for row in rows:
        row["times_plain"] = plain_us / row["time_us_median"] if row["time_us_median"] else None
    return rows, {"rows": len(rows)}


def _measure_track(params: EvaluateCost, progress: Progress) -> tuple[Rows, dict[str, Any]]:
    """Rows of the tracker's presets, sweeps and shares of the events, and which preset is the most accurate."""
    extent = tracker_cost.FULL if params.full else tracker_cost.USUAL
    rows: Rows = []
    for row in tracker_cost.tracker_cost(params.seed, extent):
        rows.append(row)
        progress(len(rows), tracker_cost.rows(extent))
    whole = [row for row in rows if row["setting"].endswith(", all events")]
    worst_px: dict[str, float] = {}
    for row in whole:
        name = row["setting"].partition(",")[0]
        worst_px[name] = max(worst_px.get(name, 0.0), row["error_px_rms"] / row["still_px_rms"])
    return rows, {
        "rows": len(rows),
        "most_accurate": min(worst_px, key=lambda name: worst_px[name]),
        **{f"{name}_error_over_still_most": share for name, share in worst_px.items()},
    }


def _summary(rows: Rows) -> dict[str, Any]:
    """How far the reference itself is off; which explicit steps blow up; what the implicit step saves.

    implicit_saves_times: run time of the most accurate explicit integration over that of the cheapest implicit one
    which is at least as accurate, by the object's position.
    """
    mechanics = [row for row in rows if row["part"] == "mechanics"]
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


def _draw(rows: Rows, path: Path) -> bool:
    """Draw log error over log run time, a row of panels for each part, a line for each integrator or mode.

    False without matplotlib. What has a setting without a knob (`8 x 10 nodes`) has no line to be on.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return False
    parts = list(dict.fromkeys(row["part"] for row in rows))
    figure = Figure(figsize=(13.0, 5.5 * len(parts)), layout="constrained")
    for place, part in zip(figure.subfigures(len(parts), 1, squeeze=False)[:, 0], parts, strict=True):
        chosen = [row for row in rows if row["part"] == part]
        names = list(dict.fromkeys(name for row in chosen for name in row if name.startswith("error_")))
        place.suptitle(f"{part}: error against run time (simulated)", fontsize=13)
        panels = place.subplots(1, len(names), squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            _draw_panel(axes, chosen, name)
        shown: dict[str, Any] = {}
        for axes in panels:
            handles, labels = axes.get_legend_handles_labels()
            shown |= dict(zip(labels, handles, strict=True))
        place.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    picture.save(figure, path)
    return True


def _draw_panel(axes: Any, rows: Rows, name: str) -> None:
    """One kind of error; an error of 0 has no place on a logarithmic axis and is left out."""
    lines: dict[str, Rows] = {}
    for row in rows:
        line, comma, _ = row["setting"].rpartition(", ")
        if row["setting"].startswith("reference"):
            axes.axhline(row[name], color="0.5", linewidth=1, linestyle=":", label="bound of the reference's own error")
        elif comma:
            lines.setdefault(line, []).append(row)
    for number, (line, every) in enumerate(lines.items()):
        points = [row for row in every if row[name] and np.isfinite(row[name])]
        lost = [row for row in every if str(row.get("outcome")).startswith("blew up")]
        if points:
            times, errors = np.array([(row["time_us_median"], row[name]) for row in points]).T
            knobs = [row["setting"].rpartition(", ")[2] for row in every]
            label = f"{line}, {_range(knobs[len(lost)], knobs[-1])}"
            label += f"; blows up from {knobs[len(lost) - 1]} on" if lost else ""
            look = {"color": f"C{number % 10}", "marker": "osD^vP*X"[number % 8], "markersize": 5}
            axes.loglog(times, errors, label=label, **look)
    axes.axvline(REAL_TIME_US, color="0.3", linewidth=1, linestyle="--", label="real time")
    first, *what = name.removeprefix("error_").split("_")
    title, unit = (" ".join(what), f" [{first}]") if first in UNITS else (" ".join((first, *what)), "")
    axes.set(title=title, xlabel="run time of a simulated millisecond, median [us]", ylabel=f"error{unit}")
    picture.quiet_grid(axes)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        # whole decades, and labels at these alone: those between would lie on each other
        axis.set_minor_formatter("")
        if axis.get_scale() == "log":
            axis.set_view_interval(10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high)), ignore=True)


def _range(first: str, last: str) -> str:
    """`dt 10 ms`, `dt 0.1 ms` as `dt 10 to 0.1 ms`."""
    if first == last:
        return first
    unit = last.rpartition(" ")[2]
    return f"{first.removesuffix(f' {unit}')} to {last.removeprefix('dt ')}"
