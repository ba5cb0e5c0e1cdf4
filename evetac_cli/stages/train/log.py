"""The course of a training: as a CSV file next to the model, and for TensorBoard during the training."""

import csv
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evetac_cli.errors import missing_extra
from evetac_cli.store.files import StageFile
from evetac_cli.store.hdf5.disk import taking_the_place_of

COLUMNS = ("step", "loss", "validation_score", "threshold", "chosen", "simulated")
OnPoint = Callable[[int, float, float | None], None]  # step, training loss, validation loss


def log_folder(model: Path) -> Path:
    """Return the folder of a model's training for TensorBoard: NAME.model.log, with a subfolder for each network."""
    return model.with_name(model.name.removesuffix(".h5") + ".log")


def require_tensorboard() -> None:
    """Raise MissingLibrary, before any work, if torch's writer for TensorBoard cannot be loaded."""
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError as error:
        raise missing_extra("the library tensorboard is not installed", "log", where="--log", error=error) from None


@contextmanager
def for_tensorboard(folder: Path | None, *, simulated: bool) -> Iterator[OnPoint | None]:
    """Yield a function that records points of one network's loss curve within the block; None without a folder."""
    if folder is None:
        yield None
        return
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(folder) as writer:

        def point(step: int, loss: float, validation_loss: float | None) -> None:
            losses = {"training": loss, "validation": validation_loss}
            for name, value in losses.items():
                if value is not None:
                    writer.add_scalar(_marked(f"loss/{name}", simulated), value, step)
            writer.flush()

        yield point


def add_checkpoints(folder: Path, arrays: dict[str, Any], about: dict[str, Any], *, simulated: bool) -> None:
    """Add the final results: the validation score of each checkpoint, and the settings of the training."""
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(folder) as writer:
        for step, score in zip(arrays["checkpoint/step"], arrays["checkpoint/score"], strict=True):
            name = _marked("score on validation trajectories", simulated)
            writer.add_scalar(name, float(score), int(step))
        lines = "".join(f"| {name} | {value} |\n" for name, value in about.items())
        writer.add_text("training", f"| | |\n|---|---|\n{lines}")


def _marked(name: str, simulated: bool) -> str:
    return f"{name} (simulated)" if simulated else name


def course(model: StageFile) -> str:
    """Return the course of a training as CSV, with a row for each step with a loss or a checkpoint's score."""
    rows: dict[int, dict[str, Any]] = {}
    if model.has("curve/loss"):
        for step, loss in zip(model.read("curve/step").tolist(), model.read("curve/loss").tolist(), strict=True):
            rows.setdefault(step, {})["loss"] = loss
    if model.has("checkpoint/step"):
        chosen_number = int(model.read("checkpoint/chosen"))
        figures = zip(
            *(model.read(f"checkpoint/{name}").tolist() for name in ("step", "score", "threshold")), strict=True
        )
        for number, (step, score, threshold) in enumerate(figures):
            row = {"validation_score": score, "threshold": threshold, "chosen": int(number == chosen_number)}
            rows.setdefault(step, {}).update(row)
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    simulated = "yes" if model.header["simulated"] else "no"
    writer.writerows({"step": step, **rows[step], "simulated": simulated} for step in sorted(rows))
    return text.getvalue()


def write_course(model: Path) -> None:
    """Write the CSV file next to a model, NAME.model.csv."""
    with StageFile(model, "model") as file:
        text = course(file)
    with taking_the_place_of(model.with_suffix(".csv")) as temporary:
        temporary.write_text(text)
