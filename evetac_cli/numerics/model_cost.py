"""evaluate cost model: how well slip detectors judge, against what one judgement costs.

With models and the report of `evaluate slip` on them, timing and F1 are those of the report, means over objects and
seeds. Without, every architecture of the table is built, untrained, and only timed. Networks that differ in their
weights alone are timed once, so that no setting wins by the noise of a clock.

- time_us_*: onnxruntime on one thread, one input at a time: what the paper's inference times are.
- step_us_*: what `grasp` does with a slice of about 500 events, from events to a probability: tracker (its default),
  features, network. A network that predicts every 5th slice costs its time in one step of five: the 99th percentile
  shows it, the median does not.

Run times are those of the machine and the moment, so the same recipe gives other figures elsewhere.
"""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, GEL_PX, ImageArchitecture
from evetac_cli.kernels.slip.detector import Detector, Live
from evetac_cli.kernels.tracking import tracker
from evetac_cli.numerics import tracker_cost
from evetac_cli.params import EvaluateCost, Grasp, recipe_of
from evetac_cli.resources import table
from evetac_cli.stages.evaluate import Rows, own_report, picture, report, report_job
from evetac_cli.stages.evaluate.slip import split_models
from evetac_cli.stages.evaluate.slip_models import Model
from evetac_cli.stages.evaluate.slip_tables import group_by_setting
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header

METHOD = 1
TRACKER = tracker.PRESETS[Grasp().tracker]
EVENTS = 500  # of a slice in a step
DISTINCT = 20  # slices that are timed in turn
REPEATS = 3000  # judgements and steps timed, fewer where that would take longer than
LONGEST_S = 2.0
FEWEST = 30
WARM = 20  # and not counted
FIGURES = {"timing": "slip_correct", "f1": "f1"}  # that a setting is judged by, and where `evaluate slip` has them
GRID = (7, 8)  # rows and columns of dots of the untrained networks


class Candidate(NamedTuple):
    """What is timed, and, if it was trained, how well it judges."""

    setting: str
    detector: Detector
    dot_shape: tuple[int, int]
    parameters: int
    graph_bytes: int
    judged: dict[str, Any] = {}

    @property
    def build(self) -> tuple[str, tuple[int, int], int]:
        """What networks share that differ in their weights alone; one that normalises has a longer graph."""
        return self.detector.architecture.name, self.dot_shape, self.graph_bytes


def jobs(files: list[Path], params: EvaluateCost, out: Path | None) -> list[Job]:
    """One report: beside that of `evaluate slip`, or without files in the present folder."""
    if not files and params.model is None:
        return [Job((), own_report("model", "cost", out))]
    judged, models = split_models(files, params.model)
    if len(judged) != 1:
        raise InputError(
            "how well do they judge?",
            where="evaluate cost model",
            expected="one report of `evaluate slip` on these models",
            found=f"{len(judged)} files that are no models",
            hint="evetac evaluate slip FEATURES --model MODELS first; without any file, untrained networks are timed",
        )
    return report_job(judged, "cost", out, *models)


def run(job: Job, params: EvaluateCost, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every setting, and a picture with the Pareto front."""
    models = [Model.read(path) for path in job.inputs[1:]]
    parents, told = _told(job.inputs[0], models) if models else ([], {})

    def measure() -> tuple[Rows, dict[str, Any]]:
        candidates = _judged(models, told) if models else _untrained()
        rows: Rows = []
        times: dict[Any, dict[str, float]] = {}
        for candidate in candidates:
            if candidate.build not in times:
                times[candidate.build] = _times(candidate, np.random.default_rng(params.seed))
            rows.append(_row(candidate, times[candidate.build]))
            progress(len(rows), len(candidates))
        summary: dict[str, Any] = {"settings": len(rows), "events_a_step": EVENTS}
        for figure in FIGURES if models else ():
            for row, best in zip(rows, front(rows, f"error_share_{figure}"), strict=True):
                row[f"pareto_{figure}"] = best
            on_front = [row["setting"] for row in rows if row[f"pareto_{figure}"]]
            summary[f"pareto_{figure}"] = "; ".join(on_front) or None
        return rows, summary

    simulated = not models  # figures from files are as simulated as these
    outcome = report(
        job, "evaluate cost", METHOD, recipe_of(params), parents, measure, force=force, simulated_source=simulated
    )
    return picture.beside(outcome, job.output, lambda figure: _draw(figure, outcome), (13.0, 5.5))


def _told(path: Path, models: Sequence[Model]) -> tuple[list[Header], dict[str, dict[str, Any]]]:
    """What a report says of these models, by setting, and the headers behind that; InputError if it is on others."""
    with StageFile(path, "report") as file:
        header, rows = file.header, json.loads(file.read("rows"))
    behind = {id_ for id_ in header["parents"] if header["history"][id_]["kind"] == "model"}
    told = {row["setting"]: row for row in rows if "seeds" in row}
    given = {model.header["id"] for model in models}
    if (
        header["parameters"].get("command") != "evaluate slip"
        or given != behind
        or {*group_by_setting(models)} != {*told}
    ):
        raise InputError(
            "this is not the report of `evaluate slip` on the models given",
            where=str(path),
            expected=f"a report on these {len(given)} models",
            found=f"{header['parameters'].get('command')}, on {len(behind)} models, {len(behind & given)} of these",
        )
    return [header, *(model.header for model in models)], told


def _judged(models: Sequence[Model], told: dict[str, dict[str, Any]]) -> list[Candidate]:
    found = []
    for setting, members in group_by_setting(models).items():
        first, row = models[members[0]], told[setting]
        errors = {
            f"error_share_{name}": None if row[figure] is None else 1 - row[figure] for name, figure in FIGURES.items()
        }
        figures = {key: row[key] for key in ("seeds", "slip_correct", "f1")}
        network = (first.detector(), first.dot_shape, first.parameters, first.graph_bytes)
        found.append(Candidate(setting, *network, figures | errors))
    return found


def _untrained() -> list[Candidate]:
    """Every architecture with weights as they are before training: run time does not depend on them."""
    from evetac_cli.kernels.slip import networks  # imports torch

    found = []
    for name, architecture in ARCHITECTURES.items():
        network = networks.build(architecture, *GRID)
        graph = networks.onnx_graph(network)
        found.append(Candidate(name, Detector(graph, architecture), GRID, networks.parameters(network), len(graph)))
    return found


def _times(candidate: Candidate, rng: np.random.Generator) -> dict[str, float]:
    time_us = timed(_one_judgement(candidate, rng))
    step_us = timed(_one_step(candidate, rng))
    return {
        "time_us_median": float(np.median(time_us)),
        "time_us_p99": float(np.percentile(time_us, 99)),
        "step_us_median": float(np.median(step_us)),
        "step_us_p99": float(np.percentile(step_us, 99)),
    }


def _row(candidate: Candidate, times: dict[str, float]) -> dict[str, Any]:
    paper_ms = table("paper")["inference"].get(candidate.detector.architecture.name)
    return {
        "setting": candidate.setting,
        **candidate.judged,
        "parameters": candidate.parameters,
        **times,
        "paper_us_on_a_gpu": None if paper_ms is None else 1000 * paper_ms,
    }


def _one_judgement(candidate: Candidate, rng: np.random.Generator) -> Callable[[], Any]:
    architecture = candidate.detector.architecture
    if isinstance(architecture, ImageArchitecture):
        shape: tuple[int, ...] = architecture.input_shape
    else:
        shape = (candidate.dot_shape[0] * candidate.dot_shape[1], architecture.inputs_per_dot)
    batch = rng.random((1, *shape), np.float32)
    return lambda: candidate.detector.probability(batch)


def _one_step(candidate: Candidate, rng: np.random.Generator) -> Callable[[], Any]:
    """A step of `grasp` on events of the dots' rims at rest; histories are filled first."""
    rows, columns = candidate.dot_shape
    whole = tracker_cost.DOTS_PX.reshape(7, 9, 2)
    if rows > whole.shape[0] or columns > whole.shape[1]:
        expected, found = "at most 7 x 9 dots", f"{rows} x {columns}"
        raise InputError("no events to time this grid on", where=candidate.setting, expected=expected, found=found)
    rest = whole[:rows, :columns].reshape(-1, 2)
    window = None if columns == whole.shape[1] else (GEL_PX[0], 0, 640, 480)
    state = tracker.start(rest, TRACKER)
    live = Live(candidate.detector, rest, window)
    slices = [_rims(rng, float(rest[:, 0].max()) + 20.0) for _ in range(DISTINCT)]
    taken = 0

    def step() -> None:
        nonlocal taken
        x, y, p = slices[taken % DISTINCT]
        taken += 1
        tracker.step(state, x, y, p)
        live.step(state.dot_xy_px, state.events_per_dot, x, y, p)

    for _ in range(candidate.detector.architecture.history):
        step()
    return step


def _rims(rng: np.random.Generator, right_px: float) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """EVENTS events on the rims of the dots left of right_px: columns x, y, p."""
    x, y, p = tracker_cost.rim_events(rng, 4 * EVENTS)
    kept = np.flatnonzero(x < right_px)[:EVENTS]
    return x[kept], y[kept], p[kept]


def timed(act: Callable[[], Any], repeats: int = REPEATS, longest_s: float = LONGEST_S) -> NDArray[np.float64]:
    """Run times in us; fewer repeats, but at least FEWEST, where they would take longer than longest_s."""
    for _ in range(WARM):
        act()
    took_us: list[float] = []
    started = time.perf_counter()
    while len(took_us) < repeats and (len(took_us) < FEWEST or time.perf_counter() - started < longest_s):
        begin = time.perf_counter()
        act()
        took_us.append((time.perf_counter() - begin) * 1e6)
    return np.array(took_us)


def front(rows: Rows, error: str) -> list[bool]:
    """Which rows are on the Pareto front of an error and the median time: no other is as good in both, better in one.

    A row without that error is not.
    """
    points = [(row[error], row["time_us_median"]) for row in rows]
    known = [point for point in points if point[0] is not None]

    def beaten(point: tuple[float, float]) -> bool:
        return any(other != point and other[0] <= point[0] and other[1] <= point[1] for other in known)

    return [point[0] is not None and not beaten(point) for point in points]


def _draw(figure: Any, outcome: Outcome) -> None:
    """Timing and F1 against run time, filled where on the front; without errors, parameters against it."""
    rows = outcome.rows
    simulated = " (simulated)" if outcome.simulated else ""
    figure.suptitle(f"Slip detectors: error against the time of one inference{simulated}")
    panels = [("parameters", "")]
    if "f1" in rows[0]:
        panels = [(f"error_share_{name}", f"pareto_{name}") for name in FIGURES]
    titles = {"error_share_timing": "share of slips not timed right", "error_share_f1": "1 - F1"}
    for axes, (key, front_key) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        best = sorted((row["time_us_median"], row[key]) for row in rows if row.get(front_key))
        if best:
            axes.step([x for x, _ in best], [y for _, y in best], where="post", color="0.4", label="Pareto front")
        for number, row in enumerate(rows):
            if row[key] is not None:
                look = {"color": f"C{number % 10}", "marker": "osD^vP*X"[number % 8], "linestyle": "none"}
                look |= {} if row.get(front_key) else {"markerfacecolor": "white"}
                axes.plot(row["time_us_median"], row[key], label=row["setting"], **look)
        axes.set_xscale("log")
        axes.set(xlabel="time of one inference, median [us]", ylabel=titles.get(key, key))
        picture.quiet_grid(axes)
        axes.legend(fontsize=7)
