"""The paper's figures on shear force, and the rows that they belong to."""

from collections.abc import Iterator

from evetac_cli.evaluate.common.marks import Conditions, Key, Paper, PaperColumn, PaperFigure, dots, scenes
from evetac_cli.evaluate.common.source import Row, Source


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
