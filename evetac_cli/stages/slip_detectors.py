"""Slip detectors from model files, their inputs from features files, and their predictions."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.slip import features, inputs, load_path, onnx_graphs, sampling
from evetac_cli.kernels.slip.architectures import (
    Architecture,
    ImageArchitecture,
    MemoryArchitecture,
    PluginImageArchitecture,
)
from evetac_cli.kernels.slip.detector import Detector, over_each
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.metrics import Prediction, shift_labels
from evetac_cli.stages import row_blocks
from evetac_cli.stages.model_files import TRUE_SLIP_SHARE, read_weights
from evetac_cli.stages.related_files import object_name
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.layout.rules import named_architecture
from evetac_cli.store.recordings.onset import abstains

# In the order of load_path.TOLD.
TOLD_COLUMNS = ("gripper_position_ticks", "gripper_goal_ticks", "gripper_goal_ma", "sticking_share", "slip_begun")


def read_trajectory(path: Path, architecture: Architecture, *, true_slip_share: bool = False) -> Trajectory:
    """Read the inputs of an architecture and the labels from a labelled features file; InputError if missing.

    true_slip_share: whether to read the true slipping share of a simulation as well, if present.
    """
    with _labelled(path) as file:
        known = true_slip_share and file.has(TRUE_SLIP_SHARE)
        return Trajectory(
            read_series(file, architecture),
            file.read("events_outside"),
            file.read("label"),
            int(file.read("onset_slice")),
            file.read(TRUE_SLIP_SHARE) if known else None,
            not abstains(file),
        )


def read_pool_sizes(path: Path, architecture: Architecture, horizon_ms: int) -> sampling.PoolSizes:
    """Return the number of samples of a labelled features file in each pool; InputError if it has no labels."""
    with _labelled(path) as file:
        labels = file.read("label"), int(file.read("onset_slice")), file.read("events_outside")
    return sampling.pool_sizes(*labels, architecture, horizon_ms)


@contextmanager
def _labelled(path: Path) -> Iterator[StageFile]:
    with StageFile(path, "features") as file:
        if not file.has("label"):
            raise InputError("the features have no labels", where=str(path), hint="evetac label, then evetac featurize")
        yield file


def read_series(file: StageFile, architecture: Architecture, start: int = 0, stop: int | None = None) -> inputs.Series:
    """Read the features that an architecture needs, for the slices [start, stop) of a file; InputError if missing."""
    if isinstance(architecture, ImageArchitecture):
        if not file.has("image"):
            message, hint = f"{architecture.name} needs event images", "evetac featurize --images"
            raise InputError(message, where=str(file.path), hint=hint)
        begin = file.read("image/start", start, None if stop is None else stop + 1)
        pixels = (file.read(f"image/{name}", int(begin[0]), int(begin[-1])) for name in ("pixel", "sign"))
        return features.EventImages(begin - begin[0], *pixels)
    if isinstance(architecture, PluginImageArchitecture):
        if not file.has("gel_events"):
            message, hint = f"{architecture.name} needs events", "evetac featurize --events"
            raise InputError(message, where=str(file.path), hint=hint)
        begin = file.read("gel_events/start", start, None if stop is None else stop + 1)
        columns = features.GelEvents._fields[1:]
        of_events = (file.read(f"gel_events/{name}", int(begin[0]), int(begin[-1])) for name in columns)
        return features.GelEvents(begin - begin[0], *of_events)
    if isinstance(architecture, MemoryArchitecture):
        return _read_load_path(file, architecture, start, stop)
    return features.series(file.read("displacement_px", start, stop), file.read("events_per_dot", start, stop))


def _read_load_path(
    file: StageFile, architecture: MemoryArchitecture, start: int, stop: int | None
) -> load_path.LoadPath:
    """Return the numbers of a detector with memory up to a slice; InputError without the sticking share."""
    assert start == 0
    if not (file.has("sticking_share") and file.has("slip_begun")):
        message, hint = f"{architecture.name} needs the sticking share", "evetac featurize --sticking-share"
        raise InputError(message, where=str(file.path), hint=hint)
    rows, columns = file.read("dot_shape").tolist()
    state = load_path.start((rows, columns), file.sensitivity, _frame_px(file))
    parts = []
    for first, last in row_blocks(file.length("sticking_share") if stop is None else stop):
        told = np.full((last - first, len(TOLD_COLUMNS)), np.nan, np.float32)
        for place, name in enumerate(TOLD_COLUMNS):
            if file.has(name):
                told[:, place] = file.read(name, first, last)
        moved_px, events = (file.read(name, first, last) for name in ("displacement_xy_px", "events_per_dot"))
        parts.append(load_path.over(state, moved_px, events, told))
    return load_path.joined(parts)


def _frame_px(file: StageFile) -> list[int]:
    """Return the frame of features with the sticking share, (width, height); InputError for an impossible one."""
    found = file.header["parameters"].get("frame_px", [*FRAME_PX])
    if not (isinstance(found, list) and len(found) == 2 and all(isinstance(side, int) and side > 0 for side in found)):
        raise InputError("not a frame", where=f"{file.path}: frame_px", expected="width and height", found=str(found))
    return found


def predict(detectors: Sequence[Detector], trajectory: Trajectory, header: Header, horizon_ms: int) -> list[Prediction]:
    """Return the probabilities by detectors of one architecture for a trajectory, from its first labelled slice.

    The labels returned with them are shifted by `horizon_ms`, for F1; the onset is not, for the timing.
    """
    slices = len(trajectory.label)
    every = [np.full(slices, np.nan, np.float32) for _ in detectors]
    first = first_labelled(trajectory.label)
    if first < slices:
        needed = inputs.part(trajectory.series, first_needed(detectors[0].architecture, first), slices)
        for probability, found in zip(every, probabilities(detectors, needed, first), strict=True):
            probability[first:] = found
    label, name = shift_labels(trajectory.label, horizon_ms), object_name(header)
    timed, slip_share = trajectory.timed, trajectory.slip_share
    return [Prediction(one, label, trajectory.onset, name, timed=timed, slip_share=slip_share) for one in every]


def first_labelled(label: NDArray[np.int8]) -> int:
    """Return the first slice with a label, before which nothing is evaluated; the number of slices if there is none."""
    examined = label >= 0
    return int(np.argmax(examined)) if examined.any() else len(label)


def first_needed(architecture: Architecture, first: int) -> int:
    """Return the first slice whose inputs a detector needs for the probability in slice `first` and later ones.

    One with memory needs all from the start.
    """
    if isinstance(architecture, MemoryArchitecture):
        return 0
    return max(0, first - architecture.history - architecture.every + 2)


def probabilities(detectors: Sequence[Detector], series: inputs.Series, first: int) -> list[NDArray[np.float32]]:
    """Return the probabilities by detectors of one architecture, starting at slice `first` of a trajectory.

    series: inputs starting at the slice `first_needed`.
    """
    begin = first_needed(detectors[0].architecture, first)
    return [found[first - begin :] for found in over_each(detectors, series, begin)]


def load_detector(model: StageFile) -> Detector:
    """Return the detector in a model file; InputError as for `check_graph`."""
    graph = check_graph(model)
    try:
        return Detector(graph, *_of_model(model))
    except ValueError as error:
        raise InputError(f"onnx: {error}", where=str(model.path), hint="train it again") from error


def check_graph(model: StageFile) -> bytes:
    """Return the graph in a model file; InputError if evetac did not make it, or if it does not match the weights."""
    architecture, shape = _of_model(model)
    weights = read_weights(model)
    graph: bytes = model.read("onnx").tobytes()
    try:
        onnx_graphs.check(graph, architecture, *shape, weights)
    except ValueError as error:
        raise InputError(f"onnx: {error}", where=str(model.path), hint="train it again") from error
    return graph


def check_checkpoints(model: StageFile) -> None:
    """Raise InputError if evetac did not make the graph of a checkpoint; its weights are stored only in the graph."""
    if not model.has("checkpoint/onnx"):
        return
    architecture, shape = _of_model(model)
    for number in range(model.length("checkpoint/onnx")):
        try:
            onnx_graphs.check(model.read("checkpoint/onnx", number, number + 1).tobytes(), architecture, *shape)
        except ValueError as error:
            where = f"checkpoint/onnx, row {number}: {error}"
            raise InputError(where, where=str(model.path), hint="train it again") from error


def _of_model(model: StageFile) -> tuple[Architecture, tuple[int, int]]:
    """Return the architecture, and the rows and columns of the dot grid."""
    rows, columns = (int(size) for size in model.read("dot_shape"))
    return named_architecture(model.read("architecture")), (rows, columns)
