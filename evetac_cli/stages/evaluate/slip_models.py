"""The models of a report on slip: read from their files, checked against the features, and run on them."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Progress
from evetac_cli.kernels.slip.architectures import Architecture
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.slip.metrics import Prediction
from evetac_cli.stages.slip_detectors import load_detector, predict, read_horizon_ms, read_trajectory
from evetac_cli.stages.splits import check_disjoint, object_name
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header

NOT_WEIGHTS = ("input_scale", "input_offset")  # fixed, not trained


@dataclass(frozen=True)
class Model:
    """A trained detector: what the report needs of its model file."""

    path: Path
    header: Header
    architecture: Architecture
    graph_bytes: int
    horizon_ms: int
    threshold: float
    dot_shape: tuple[int, int]
    parameters: int  # number of trained weights and biases

    @classmethod
    def read(cls, path: Path) -> "Model":
        """Read a model file; InputError if it is another kind of file, or damaged."""
        with StageFile(path, "model") as file:
            rows, columns = (int(size) for size in file.read("dot_shape"))
            shapes = {name: shape for name, (_, shape) in file.contents().items() if name.startswith("weights/")}
            return cls(
                path,
                file.header,
                load_detector(file).architecture,
                file.length("onnx"),
                read_horizon_ms(file),
                float(file.read("threshold")),
                (rows, columns),
                sum(int(np.prod(shape)) for name, shape in shapes.items() if not name.endswith(NOT_WEIGHTS)),
            )

    def detector(self) -> Detector:
        """The network, ready to run.

        Why so: made when it is needed, because onnxruntime, which runs those on images, keeps the memory of its
        largest batch for each network: a gigabyte.
        """
        with StageFile(self.path, "model") as file:
            return load_detector(file)

    @property
    def labels(self) -> str:
        """The methods that labelled its training trajectories, `truth` included."""
        labels = (header for header in self._training_ancestors() if header["kind"] == "labels")
        return ", ".join(sorted({labelled_by(header) for header in labels})) or "none"

    @property
    def scenes(self) -> str:
        """The scenes of its training trajectories; `unknown` for imported ones."""
        recordings = (header for header in self._training_ancestors() if header["kind"] == "recording")
        return " + ".join(
            sorted({header["parameters"].get("scene", {}).get("name", "unknown") for header in recordings})
        )

    def _training_ancestors(self) -> Iterator[Header]:
        """Headers of the files that its training features were made from."""
        history, chosen = self.header["history"], self.header["parameters"]
        for one in self.header["parents"][: chosen.get("trained_on")]:
            yield from (history[parent] for parent in history[one]["parents"])

    @property
    def objects(self) -> set[str]:
        """The objects of the trajectories that it was trained and validated on."""
        return {object_name({**ancestor, "history": {}}) for ancestor in self.header["history"].values()} - {"unknown"}

    @property
    def setting(self) -> str:
        """A text that is equal for two models that differ in their seed alone."""
        chosen = {key: value for key, value in self.header["parameters"].items() if key != "seed"}
        return json.dumps([chosen, self.header["parents"]], sort_keys=True)


def labelled_by(header: Header) -> str:
    """The method of a labels header."""
    return str(header["parameters"].get("method", "farneback"))


def check(models: Sequence[Model], paths: Sequence[Path]) -> list[Header]:
    """Headers of features that these models can be evaluated on.

    InputError for features without labels, of another dot grid, or of a recording that a model has seen.
    """
    headers = []
    for path in paths:
        with StageFile(path, "features") as file:
            if not file.has("label"):
                raise InputError("the features have no labels", where=str(path), hint="evetac label, then featurize")
            shape = tuple(file.read("dot_shape").tolist())
            for model in models:
                if shape != model.dot_shape:
                    raise InputError(
                        f"the features have another dot grid than {model.path}",
                        where=str(path),
                        expected=str(list(model.dot_shape)),
                        found=str(list(shape)),
                    )
            headers.append(file.header)
    for model in models:
        check_disjoint([model.header], headers, f"evaluated on, with {model.path}", paths)
    return headers


def predict_all(
    models: Sequence[Model], paths: Sequence[Path], headers: Sequence[Header], progress: Progress
) -> list[list[Prediction]]:
    """The predictions of each model for all trajectories; a trajectory is read once for each architecture."""
    by_model: list[list[Prediction]] = [[] for _ in models]
    done = 0
    for architecture in dict.fromkeys(model.architecture for model in models):
        trajectories = [read_trajectory(path, architecture) for path in paths]
        for model, predictions in zip(models, by_model, strict=True):
            if model.architecture == architecture:
                detector = model.detector()
                for trajectory, header in zip(trajectories, headers, strict=True):
                    predictions.append(predict(detector, trajectory, header, model.horizon_ms))
                    done += 1
                    progress(done // len(models), len(paths))
    return by_model
