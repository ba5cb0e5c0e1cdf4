"""The part `model`: accuracy of slip detectors against the run time of one inference.

With models and the report of `evaluate slip` on them, timing and F1 come from the report, as means over objects and
seeds. Detectors of slip now, 10 ms and 20 ms ahead have different tasks, so each task has its own Pareto front. Without
models, every architecture of the table is built, untrained, and only timed. Networks that differ only in their weights
are timed once, so that no setting wins by clock noise.

- time_us_*: the network on one thread, one input at a time, as `grasp` runs it, comparable to the paper's inference
  times.
- step_us_*: processing of a slice of about 500 events in `grasp`, from events to a probability: tracker (its default),
  features, network. A network that predicts every 5th slice spends its time in one of five steps: the 99th percentile
  shows it, the median does not.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from itertools import cycle
from math import nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.rows import collect, run_times, timed_us
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost.tracker import DOTS_PX, rim_events
from evetac_cli.evaluate.slip import PAPER
from evetac_cli.evaluate.slip.measure import split_models
from evetac_cli.evaluate.slip.models import Model
from evetac_cli.evaluate.slip.tables import group_by_setting
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, GEL_PX, MemoryArchitecture, OverImages, channels
from evetac_cli.kernels.slip.detector import Detector, LiveDetector
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.store.files import StageFile

TRACKER = presets.PRESETS[Grasp().tracker]
EVENTS = 500  # per slice in a step
DISTINCT = 20  # slices timed in turn
REPEATS, LONGEST_S = 3000, 2.0  # timed inferences and steps; fewer if they would take longer
FIGURES = {"timing": "slip_correct", "f1": "f1"}  # errors of a setting, and their columns in `evaluate slip`
OF_REPORT = ("model", "preset", "seeds", "trajectories", "folds", "true_slip_share", "slip_correct", "f1")
GRID = (7, 8)  # rows and columns of dots of the untrained networks


class Candidate(NamedTuple):
    """A network to time, and its figures in `evaluate slip` if it is trained."""

    setting: str
    detector: Detector
    dot_shape: tuple[int, int]
    parameters: int
    graph_bytes: int
    horizon_ms: int = 0
    figures: Row = {}

    @property
    def build(self) -> tuple[str, tuple[int, int], int]:
        """Equal for networks that differ only in their weights; one that normalises has a longer graph."""
        return self.detector.architecture.name, self.dot_shape, self.graph_bytes


def inputs(files: list[Path], model: Path | None) -> tuple[Path, ...]:
    """Return the report of `evaluate slip`, then the models; empty without any file."""
    if not files and model is None:
        return ()
    reports, models = split_models(files, model)
    if len(reports) != 1:
        expected, found = "one report of `evaluate slip` on these models", f"{len(reports)} files that are not models"
        hint = "run evetac evaluate slip FEATURES --model MODELS; without files, untrained networks are timed"
        raise InputError("a report is missing", where="evaluate cost model", expected=expected, found=found, hint=hint)
    return (*reports, *models)


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return a row per setting; with a report, also whether it is on the Pareto front of its task."""
    models = [Model.read(path) for path in inputs[1:]]
    candidates = _trained(models, _report_rows(inputs[0], models)) if models else _untrained()
    rows = collect(_rows(candidates, params.seed), len(candidates), progress)
    for figure in FIGURES if models else ():
        for row, on_front in zip(rows, front(rows, f"error_share_{figure}"), strict=True):
            row[f"pareto_{figure}"] = on_front
    return rows


def summary(rows: Rows) -> dict[str, Any]:
    """Return the number of settings, and those on the Pareto fronts."""
    figures: dict[str, Any] = {"settings": len(rows), "events_a_step": EVENTS}
    for name in (f"pareto_{figure}" for figure in FIGURES):
        for task in sorted({row["horizon_ms"] for row in rows if name in row}):
            on_front = [row["setting"] for row in rows if row[name] and row["horizon_ms"] == task]
            figures[f"{name}_{task}_ms_ahead"] = "; ".join(on_front) or None
    return figures


def _report_rows(path: Path, models: Sequence[Model]) -> dict[str, Row]:
    """Return rows of a report of `evaluate slip` by setting; raise InputError if it is not on these models."""
    with StageFile(path, "report") as file:
        header, rows = file.header, json.loads(file.read("rows"))
    reported = {id_ for id_ in header["parents"] if header["history"][id_]["kind"] == "model"}
    by_setting = {row["setting"]: row for row in rows if "seeds" in row}
    model_ids = {model.header["id"] for model in models}
    command = header["parameters"].get("command")
    if command != "evaluate slip" or model_ids != reported or {*group_by_setting(models)} != {*by_setting}:
        expected = f"the report of `evaluate slip` on these {len(model_ids)} models"
        found = f"{command}, on {len(reported)} models, {len(reported & model_ids)} of these"
        raise InputError("another report", where=str(path), expected=expected, found=found)
    return by_setting


def _trained(models: Sequence[Model], report_rows: dict[str, Row]) -> list[Candidate]:
    """Return one candidate per setting, with the figures of its row in the report."""
    candidates = []
    for setting, members in group_by_setting(models).items():
        first, row = models[members[0]], report_rows[setting]
        errors = {
            f"error_share_{name}": None if row[figure] is None else 1 - row[figure] for name, figure in FIGURES.items()
        }
        figures = {key: row[key] for key in OF_REPORT if key in row}
        network = (first.detector(), first.dot_shape, first.parameters, first.graph_bytes)
        candidates.append(Candidate(setting, *network, first.horizon_ms, figures | errors))
    return candidates


def _untrained() -> list[Candidate]:
    """Return every architecture with its initial weights: run time does not depend on them."""
    from evetac_cli.kernels.slip import networks  # imports torch

    candidates = []
    for name, architecture in ARCHITECTURES.items():
        network = networks.build(architecture, *GRID)
        graph = networks.onnx_graph(network)
        detector, size = Detector(graph, architecture), networks.parameters(network)
        candidates.append(Candidate(name, detector, GRID, size, len(graph)))
    return candidates


def _rows(candidates: Sequence[Candidate], seed: int) -> Iterator[Row]:
    """Yield the row of each candidate; networks of the same build share their run times."""
    times: dict[Any, Row] = {}
    for candidate in candidates:
        if candidate.build not in times:
            rng = np.random.default_rng(seed)
            acts = _inference(candidate, rng), _grasp_step(candidate, rng)
            inference_us, step_us = (timed_us(act, REPEATS, LONGEST_S) for act in acts)
            times[candidate.build] = run_times(inference_us) | run_times(step_us, "step")
        paper_ms = PAPER.value("inference", candidate.detector.architecture.name)
        yield {
            "setting": candidate.setting,
            "horizon_ms": candidate.horizon_ms,
            **candidate.figures,
            "parameters": candidate.parameters,
            **times[candidate.build],
            "inference_ms_median": times[candidate.build]["time_us_median"] / 1000,
            "paper_inference_ms": paper_ms,
        }


def _inference(candidate: Candidate, rng: np.random.Generator) -> Callable[[], Any]:
    """Return a function that runs one inference on one random input."""
    architecture = candidate.detector.architecture
    if isinstance(architecture, OverImages):
        shape: tuple[int, ...] = architecture.input_shape
    elif isinstance(architecture, MemoryArchitecture):
        shape = (channels(architecture),)
    else:
        shape = (candidate.dot_shape[0] * candidate.dot_shape[1], architecture.inputs_per_dot)
    batch = rng.random((1, *shape), np.float32)
    return lambda: candidate.detector.probability(batch)


def _grasp_step(candidate: Candidate, rng: np.random.Generator) -> Callable[[], Any]:
    """Return a function that runs one `grasp` step on events of the dots' rims at rest; histories are filled first."""
    rows, columns = candidate.dot_shape
    whole = DOTS_PX.reshape(7, 9, 2)
    if rows > whole.shape[0] or columns > whole.shape[1]:
        found = f"{rows} x {columns}"
        raise InputError("too many dots to time", where=candidate.setting, expected="at most 7 x 9", found=found)
    rest = whole[:rows, :columns].reshape(-1, 2)
    window = None if columns == whole.shape[1] else (GEL_PX[0], 0, 640, 480)
    live = LiveDetector(candidate.detector, tracker.start(rest, TRACKER), window)
    live.tell(nan, nan, 0.5, 0.5)  # contact, which a network with memory waits for
    right_px = float(rest[:, 0].max()) + 20.0
    slices = cycle([_rims(rng, right_px) for _ in range(DISTINCT)])

    def step() -> None:
        live.step(*next(slices))

    for _ in range(candidate.detector.architecture.history):
        step()
    return step


def _rims(rng: np.random.Generator, right_px: float) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return EVENTS events on the rims of the dots left of right_px: columns x, y, p."""
    x, y, p = rim_events(rng, 4 * EVENTS)
    left = np.flatnonzero(x < right_px)[:EVENTS]
    return x[left], y[left], p[left]


def front(rows: Rows, error: str) -> list[bool]:
    """Return which rows are on the Pareto front of an error and the median time within their task (`horizon_ms`).

    On the front, no other row is as good in both and better in one. A row without that error is not on the front.
    """
    points = [(row["horizon_ms"], row[error], row["time_us_median"]) for row in rows]
    measured = [point for point in points if point[1] is not None]

    def beaten(point: tuple[int, float, float]) -> bool:
        same_task = (other for other in measured if other[0] == point[0] and other != point)
        return any(error <= point[1] and time_us <= point[2] for _, error, time_us in same_task)

    return [point[1] is not None and not beaten(point) for point in points]


def size_in(rows: Rows) -> tuple[float, float]:
    """Return width and height of the plot in inches."""
    return 12.0, 4.6 + picture.legend_height_in([row["setting"] for row in rows], 12.0)


def draw(figure: Any, rows: Rows, errors: Sequence[str]) -> None:
    """Plot errors against run time, filled if on the front of the task; without errors, plot parameters."""
    names = [name for name in errors if name in rows[0]] or ["parameters"]
    titles = {"error_share_timing": "share of slips not timed correctly", "error_share_f1": "1 - F1"}
    panels = picture.panels(figure, len(names), len(names))
    for axes, name in zip(panels, names, strict=True):
        front_column = name.replace("error_share", "pareto")
        for task, shade in zip(sorted({row["horizon_ms"] for row in rows}), ("0.2", "0.5", "0.75"), strict=False):
            on_front = [row for row in rows if row.get(front_column) and row["horizon_ms"] == task]
            best = sorted((row["time_us_median"], row[name]) for row in on_front)
            if best:
                label = f"Pareto front, {task} ms ahead"
                axes.step([x for x, _ in best], [y for _, y in best], where="post", color=shade, label=label)
        for number, row in enumerate(rows):
            if row[name] is not None:
                style = {**picture.series(number), "markersize": 7, "linestyle": "none"}
                style |= {} if row.get(front_column) else {"markerfacecolor": "white"}
                axes.plot(row["time_us_median"], row[name], label=row["setting"], **style)
        axes.set(xlabel="run time of one inference, median [us]", ylabel=titles.get(name, "trained parameters"))
        picture.log_axis(axes.xaxis)
        if name == "parameters":
            picture.log_axis(axes.yaxis)
        else:
            axes.set_ylim(0, None)
    picture.legend(figure, panels, title="filled: on the Pareto front" if names != ["parameters"] else None)
