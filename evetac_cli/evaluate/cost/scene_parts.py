"""The part `scenes`: run time per slice of the parts of three scenes, each scene with and without them."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from evetac_cli.commands.evaluate import EvaluateCost
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.evaluate import picture
from evetac_cli.evaluate.cost.chain import GRASP_CHOICES
from evetac_cli.evaluate.rows import Extent, run_times
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.simulated import play as play_grasp
from evetac_cli.trials.part_costs import PartCosts, Play
from evetac_cli.trials.part_costs import measure as measure_parts
from evetac_cli.trials.record.simulated import play_through
from evetac_cli.trials.trial import SimulatedTrial

REPEATS = Extent(quick=3, full=10)
AS_IT_IS = "as it is"
COLUMNS = ("part", "setting", "time_us_mean", "time_us_median", "time_us_p99", "part_us")


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return for each scene a row as is, a row per optional part, and the run times of the calls in it."""
    rows: Rows = []
    trials = list(_trials(params.seed))
    for done, (name, trial, play) in enumerate(trials, 1):
        costs = measure_parts(trial, play, REPEATS.pick(params.full))
        rows += [{"part": name, **row} for row in _rows(costs)]
        progress(done, len(trials))
    return rows


def _trials(seed: int) -> Iterator[tuple[str, SimulatedTrial, Play[Any]]]:
    """Yield slip, lift with the pretrained detector, and rubbed edges: scenes that are slow for different reasons."""
    slip, edge = (Record(scene=name, seed=seed) for name in ("slip", "edge"))
    lift: tuple[Any, Any, Play[Any]] = (grasp, Grasp(seed=seed, **GRASP_CHOICES), play_grasp)
    stages = [(record, slip, play_through), lift, (record, edge, play_through)]
    for stage, params, play in stages:
        (trial,) = stage.jobs([], params, None)
        yield params.scene, trial, play


def _rows(costs: PartCosts) -> Iterator[Row]:
    """Yield the rows of a scene; part_us: run time of the part if it is used, or its cost if it were."""
    yield {"setting": AS_IT_IS, "time_us_mean": float(costs.whole.mean()), **run_times(costs.whole), "part_us": None}
    left_out = {row["part"] for row in costs.rows() if row["left_out"]}
    for part, times_us in costs.switched.items():
        figures = {"time_us_mean": float(times_us.mean()), **run_times(times_us), "part_us": costs.more_us(part)}
        yield {"setting": f"{'with' if part in left_out else 'without'} {part}", **figures}
    for row in costs.rows():
        if row["time_us"] is not None and row["part"] not in costs.switched:
            yield {**dict.fromkeys(COLUMNS[1:]), "setting": f"of it {row['part']}", "part_us": row["time_us"]}


def summary(rows: Rows) -> dict[str, Any]:
    """Return microseconds per slice of each scene, and the savings from its left-out parts."""
    figures: dict[str, Any] = {}
    for scene in dict.fromkeys(row["part"] for row in rows):
        own = [row for row in rows if row["part"] == scene]
        figures[f"{scene}_us"] = next(row["time_us_mean"] for row in own if row["setting"] == AS_IT_IS)
        figures[f"{scene}_saves_us"] = sum(row["part_us"] for row in own if row["setting"].startswith("with "))
    return figures


def draw(figure: Any, rows: Rows, errors: Sequence[str]) -> None:
    """Draw a panel per scene: bars of the time per slice, as is and with one part switched."""
    scenes = list(dict.fromkeys(row["part"] for row in rows))
    for axes, scene in zip(picture.panels(figure, len(scenes), 1), scenes, strict=True):
        own = [row for row in rows if row["part"] == scene and row["time_us_mean"] is not None][::-1]
        bars = axes.barh([row["setting"] for row in own], [row["time_us_mean"] for row in own], height=0.6)
        axes.bar_label(bars, fmt="%.0f", padding=3)
        axes.set(title=picture.plain(f"scene {scene}"), xlabel="run time per simulated millisecond, mean [us]")
        axes.margins(x=0.12)
