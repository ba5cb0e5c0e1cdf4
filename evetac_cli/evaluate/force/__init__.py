"""evaluate force: estimated forces against the true ones."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, Row, Source, dots, scenes
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, grouped, having
from evetac_cli.jobs import Rows


def _figures() -> Iterator[tuple[Key, PaperFigure]]:
    where = "Dot-based Shear Force Reconstruction, table"
    for model, sensor, errors in (  # mean absolute error and its sd, of Fx and Fy
        ("regression", "events", ((0.53, 0.41), (0.41, 0.29))),
        ("regression", "frames", ((0.53, 0.49), (0.44, 0.29))),
        ("network", "events", ((0.33, 0.25), (0.22, 0.18))),
        ("network", "frames", ((0.35, 0.30), (0.37, 0.26))),
    ):
        for axis, of_axis in zip("xy", errors, strict=True):
            for quantity, value in zip(("mae", "sd"), of_axis, strict=True):
                yield (quantity, model, sensor, axis), PaperFigure(value, "N", where, _conditions(model, sensor))
    where = "Dot-based Shear Force Reconstruction"
    for sensor, shares in (("events", (0.37, 0.46)), ("frames", (0.37, 0.16))):
        for axis, less in zip("xy", shares, strict=True):
            figure = PaperFigure(less, "share", where, _conditions("network", sensor))
            yield ("less by the network", sensor, axis), figure
    for axis, ratio in (("x", 1.0), ("y", 1.07)):  # of its table's figures; in words "similar quality"
        yield ("RGB over Evetac", axis), PaperFigure(ratio, "ratio", where, _conditions("regression", "events"))


def _conditions(model: str, sensor: str) -> Conditions:
    return Conditions(model, "shear", (1, 4), "dots by paper" if sensor == "events" else "frames")


def _of_axis(quantity: str, axis: str) -> PaperColumn:
    def key(row: Row) -> Key:
        return quantity, row["model"], row["sensor"], axis

    def ours(row: Row, source: Source) -> Conditions:
        inputs = "frames" if row["sensor"] == "frames" else dots(row, source)
        return Conditions(row["model"], scenes(source), (row["trajectories"], source.training_recordings), inputs)

    return PaperColumn(key, ours, ("sensor", "model", "trajectories"), ("tracker",))


PAPER = Paper(
    dict(_figures()),
    {f"paper_{quantity}_n_{axis}": _of_axis(quantity, axis) for quantity in ("mae", "sd") for axis in "xy"},
)


@dataclass(frozen=True)
class EvaluateForce:
    """Compare forces estimated by touch maps or by the paper's models with the true ones (simulated recordings)."""

    model: str = parameter(
        "",
        "Force model trained by the paper's method, or a folder or glob of several. Each is evaluated on the tracks of"
        " its own sensor. Default: none, touch maps are evaluated.",
        recipe=False,
    )
    adapt_on: str = parameter(
        "",
        "Tracks (folder or glob) of the same sensors, on which touch maps are adapted first; adds rows per sensor.",
        recipe=False,
    )
    identified: str = parameter(
        "",
        "Folder with files of the same sensors from `evetac identify`, e.g. 7.sensor.toml for randomized:7; adds a row"
        " for each sensor with such a file.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1, "For touch maps: relative error of the assumed modulus (standard deviation).", low=0.0, high=2.0
    )
    samples: int = parameter(
        200, "For the paper's models: samples per trajectory, evenly spread over the contact.", low=3, high=100000
    )
    noise_n: float = parameter(
        0.05,
        "Noise of the force sensor that serves as reference or for adaptation (standard deviation).",
        unit="N",
        low=0.0,
        high=100.0,
    )
    seed: int = parameter(0, "Seed of the noise and of the modulus error.", low=0, high=2**31 - 1)


def _means(members: Rows, *keys: str) -> Row:
    known = {key: [row[key] for row in members if row.get(key) is not None] for key in keys}
    return {key: sum(values) / len(values) if values else None for key, values in known.items()}


def _forces(rows: Rows, summary: dict[str, Any]) -> Rows:
    """Return means over trajectories for each sensor and model of the paper's method."""
    rows = [{"tracker": None, **row} for row in having("model", "sensor", "mae_n_x")(rows, summary)]
    groups = grouped(rows, ("sensor", "tracker", "model", "sensor_name"))
    keys = ("mae_n_x", "mae_n_y", "paper_mae_n_x", "paper_mae_n_y")
    return [{**members[0], "trajectories": len(members), **_means(members, *keys)} for members in groups]


def _gel_forces(rows: Rows, summary: dict[str, Any]) -> Rows:
    """Return means over trajectories by knowledge of the gel."""
    keys = ("mae_n", "normal_mae_n", "shear_within_sd", "normal_within_sd", "contact_right")
    groups = grouped(having("stiffness", "mae_n")(rows, summary), ("stiffness",))
    return [
        {
            **members[0],
            "trajectories": len(members),
            "counted": sum(row["mae_n"] is not None for row in members),
            **_means(members, *keys),
        }
        for members in groups
    ]


SUBJECT = Subject(
    "force",
    EvaluateForce,
    "evaluate.force.measure",
    "Tracks of simulated shear recordings.",
    kind="tracks",
    examples=("evetac evaluate force unseen", "evetac evaluate force unseen --model shear.force-model.h5"),
    panel=OWN_DATA,
    title="Forces from dots",
    about=(
        "Mean absolute error over unseen trajectories. Touch maps have errors only where a contact is found and enough"
        " dots are tracked."
    ),
    tables=(
        SubjectTable(
            "Shear force, models for one sensor",
            _forces,
            ("sensor", "tracker", "model", "sensor_name", "trajectories", "mae_n_x", "mae_n_y"),
        ),
        SubjectTable(
            "Forces, a model for any sensor",
            _gel_forces,
            (
                *("stiffness", "trajectories", "counted", "mae_n", "normal_mae_n"),
                *("shear_within_sd", "normal_within_sd", "contact_right"),
            ),
        ),
    ),
    paper=PAPER,
)
