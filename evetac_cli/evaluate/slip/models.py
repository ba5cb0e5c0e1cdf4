"""The models of a report on slip: read from their files, checked against the features, and run on them.

Their probabilities are stored in a folder next to the report, `NAME.judged`: one zip archive per trajectory, named by
its recipe id, with the probabilities of each model as float32. So a report on more models or trajectories computes only
what is new, and an interrupted report continues. The folder can be removed at any time.

Covariates of the slips come from the truth of the simulated recordings behind the features. Without truth they come
from labels and events in the features, which have no event positions: events outside the strip of the window count too.
"""

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.label import Label
from evetac_cli.errors import MAKE_MODEL, EvetacError, InputError
from evetac_cli.jobs import Progress, Rows
from evetac_cli.kernels.slip.architectures import Architecture
from evetac_cli.kernels.slip.covariates import WORDS, SlipCovariates, of_labels, summary
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.slip.metrics import Prediction, shift_labels
from evetac_cli.stages.label_methods import from_truth
from evetac_cli.stages.model_files import (
    chosen_threshold,
    labelled_by,
    learned_true_slip_share,
    read_horizon_ms,
)
from evetac_cli.stages.related_files import (
    OTHER_FOLDER,
    Origins,
    check_disjoint,
    check_made_from,
    object_name,
    sensor_names,
    sensor_of,
)
from evetac_cli.stages.slip_detectors import first_labelled, first_needed, load_detector, probabilities, read_series
from evetac_cli.store.files import StageFile
from evetac_cli.store.hdf5.disk import taking_the_place_of
from evetac_cli.store.layout.ancestry import TRAINING
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.onset import abstains, covariates_of_truth
from evetac_cli.store.recordings.read import open_recording

AT_ONCE = 8  # trajectories per parallel task
MOST_SLICES = 1 << 17  # in memory at once; trajectories of hours are split
JUDGING = 1  # increase if the same model and features result in other probabilities
NOT_WEIGHTS = ("input_scale", "input_offset")  # fixed, not trained


@dataclass(frozen=True)
class Model:
    """A trained detector: the parts of its model file that the report needs."""

    path: Path
    header: Header
    architecture: Architecture
    graph_bytes: int
    key: str  # of stored probabilities; depends on the graph, which may differ between computers
    horizon_ms: int
    threshold: float
    dot_shape: tuple[int, int]
    parameters: int  # number of trained weights and biases
    over_dots: Detector | None  # None for networks on images

    @classmethod
    def read(cls, path: Path) -> "Model":
        """Read a model file; raise InputError if it is damaged or another kind of file."""
        with StageFile(path, "model") as file:
            rows, columns = (int(size) for size in file.read("dot_shape"))
            detector = load_detector(file)
            shapes = {name: shape for name, (_, shape) in file.contents().items() if name.startswith("weights/")}
            return cls(
                path,
                file.header,
                detector.architecture,
                file.length("onnx"),
                hashlib.sha256(f"{JUDGING} {file.header['id']} ".encode() + file.read("onnx").tobytes()).hexdigest(),
                read_horizon_ms(file),
                float(file.read("threshold")),
                (rows, columns),
                sum(int(np.prod(shape)) for name, shape in shapes.items() if not name.endswith(NOT_WEIGHTS)),
                detector if detector.dot_weights or detector.memory_weights else None,
            )

    def detector(self) -> Detector:
        """Return the network, ready to run.

        Networks on images are loaded only when needed: onnxruntime, which runs them, keeps the memory of the largest
        batch of each network, a gigabyte.
        """
        if self.over_dots is not None:
            return self.over_dots
        with StageFile(self.path, "model") as file:
            return load_detector(file)

    def threshold_for(self, threshold: float | None, false_alarms_per_min: float | None) -> float:
        """Return the threshold for the evaluation, see `chosen_threshold`."""
        with StageFile(self.path, "model") as file:
            return chosen_threshold(file, threshold, false_alarms_per_min)

    @property
    def labels(self) -> str:
        """The methods that labelled its training trajectories, including `truth`."""
        return labelled_by(self.header) or "none"

    @property
    def learned_true_slip_share(self) -> bool:
        """Whether it also learned the true slipping share of the contact, in addition to the labels."""
        return learned_true_slip_share(self.header)

    @property
    def scenes(self) -> str:
        """The scenes of its training trajectories; `unknown` for imported ones."""
        learned = [row for row in self.header["trajectories"] if row["role"] == TRAINING]
        return " + ".join(sorted({row["scene"] or "unknown" for row in learned}))

    @property
    def objects(self) -> set[str]:
        """The objects of the trajectories that it was trained and validated on."""
        return {str(row["object"]) for row in self.header["trajectories"] if row["object"] is not None}

    @property
    def setting(self) -> str:
        """A text that is equal for models that differ only in their seed."""
        parameters = {key: value for key, value in self.header["parameters"].items() if key != "seed"}
        return json.dumps([parameters, self.header["parents"]], sort_keys=True)


def check(models: Sequence[Model], paths: Sequence[Path], *, labels_needed: bool = True) -> list[Header]:
    """Return the headers of features on which these models can be evaluated.

    Raises InputError for features without labels, with another dot grid, or of a recording that a model was trained on.
    """
    headers = []
    for path in paths:
        with StageFile(path, "features") as file:
            if labels_needed and not file.has("label"):
                raise InputError("no labels", where=str(path), hint="run evetac label, then evetac featurize")
            shape = tuple(file.read("dot_shape").tolist())
            for model in models:
                if shape != model.dot_shape:
                    expected, found = f"{list(model.dot_shape)}, as {model.path}", str(list(shape))
                    raise InputError(
                        "another dot grid", where=str(path), expected=expected, found=found, hint=MAKE_MODEL
                    )
            headers.append(file.header)
    for model in models:
        check_disjoint([model.header], headers, f"evaluated on, with {model.path}", paths)
    return headers


def predict_all(
    models: Sequence[Model],
    paths: Sequence[Path],
    headers: Sequence[Header],
    progress: Progress,
    folder: Path | None = None,
    recordings: Sequence[Path] | None = None,
) -> list[list[Prediction]]:
    """Return the predictions of each model for all trajectories; results stored in `folder` are reused.

    recordings: of each trajectory; then labels and onsets are those of their truth, as by `label --method truth`.
    """
    sensors = sensor_names([sensor_of(header) for header in headers])
    by_model: list[list[Prediction]] = [[] for _ in models]
    for begin in range(0, len(paths), AT_ONCE):
        chunk = slice(begin, begin + AT_ONCE)
        with ExitStack() as stack:
            files = [stack.enter_context(StageFile(path, "features")) for path in paths[chunk]]
            if recordings is None:
                found = [
                    _Answer(file.read("label"), int(file.read("onset_slice")), not abstains(file)) for file in files
                ]
            else:
                found = [_by_truth(path) for path in recordings[chunk]]
            # Slices that one of the two labels and the other does not have a probability in one alone.
            names = [f"{header['id']}{'' if recordings is None else '-truth'}.zip" for header in headers[chunk]]
            places = [None if folder is None else folder / name for name in names]
            probabilities = _judge(models, files, [answer.label for answer in found], places)
            every = zip(found, headers[chunk], sensors[chunk], probabilities, strict=True)
            for (label, onset, timed, share), header, sensor, of_models in every:
                for model, predictions, probability in zip(models, by_model, of_models, strict=True):
                    shifted = shift_labels(label, model.horizon_ms)
                    of = object_name(header), sensor
                    predictions.append(Prediction(probability, shifted, onset, *of, timed, share))
        progress(min(begin + AT_ONCE, len(paths)), len(paths))
    return by_model


class _Answer(NamedTuple):
    """What a trajectory's probabilities are compared with, as in `Prediction`."""

    label: NDArray[np.int8]
    onset: int
    timed: bool = True
    slip_share: NDArray[np.float32] | None = None


def _by_truth(path: Path) -> _Answer:
    """Return the truth of a simulated recording."""
    with open_recording(path) as recording:
        labels = from_truth(recording, Label().after_ms)
        return _Answer(labels.label, labels.onset, slip_share=recording.read("truth/visible_slip_share"))


def _judge(
    models: Sequence[Model],
    files: Sequence[StageFile],
    labels: Sequence[NDArray[np.int8]],
    places: Sequence[Path | None],
) -> list[list[NDArray[np.float32]]]:
    """Return the probabilities of each model for a few trajectories, by trajectory; store them in `places`, if given.

    A trajectory is read once per architecture that has not been evaluated on it.
    """
    stored = [{} if place is None else _read_kept(place) for place in places]
    spans: list[tuple[int, int]] = []
    by_path: list[list[NDArray[np.float32]]] = []
    missing: list[set[int]] = []
    for label, kept in zip(labels, stored, strict=True):
        kept_values = [_probabilities(kept.get(model.key), len(label)) for model in models]
        missing.append({index for index, one in enumerate(kept_values) if one is None})
        spans.append((first_labelled(label), len(label)))
        by_path.append([np.full(len(label), np.nan, np.float32) if one is None else one for one in kept_values])
    for architecture in dict.fromkeys(model.architecture for model in models):
        members = [index for index, model in enumerate(models) if model.architecture == architecture]
        new = {number: spans[number] for number, gaps in enumerate(missing) if gaps.intersection(members)}
        for pieces in _pieces(new):
            series = [
                read_series(files[number], architecture, first_needed(architecture, first), stop)
                for number, first, stop in pieces
            ]
            for index in members:
                waiting = [(*one, part) for one, part in zip(pieces, series, strict=True) if index in missing[one[0]]]
                if waiting:
                    detector = models[index].detector()
                for number, first, stop, part in waiting:
                    (by_path[number][index][first:stop],) = probabilities([detector], part, first)
    for place, kept, of_path, gaps in zip(places, stored, by_path, missing, strict=True):
        if place is not None and gaps:
            kept |= {models[index].key: of_path[index].tobytes() for index in sorted(gaps)}
            with taking_the_place_of(place) as temporary, ZipFile(temporary, "w") as archive:
                for key, values in kept.items():
                    archive.writestr(key, values)
    return by_path


class _Piece(NamedTuple):
    """The slices [first, stop) of the trajectory with this number."""

    number: int
    first: int
    stop: int


def _pieces(spans: Mapping[int, tuple[int, int]]) -> Iterator[list[_Piece]]:
    """Split slices [begin, end) of trajectories into pieces; yield pieces that are in memory together."""
    together: list[_Piece] = []
    room = MOST_SLICES
    for number, (begin, end) in spans.items():
        done = begin
        while done < end:
            piece = _Piece(number, done, min(end, done + room))
            together.append(piece)
            room -= piece.stop - done
            done = piece.stop
            if room == 0:
                yield together
                together, room = [], MOST_SLICES
    if together:
        yield together


def _read_kept(path: Path) -> dict[str, bytes]:
    """Return the stored probabilities of a trajectory by model key; empty if the file is missing or damaged."""
    try:
        with ZipFile(path) as archive:
            plain = [item for item in archive.infolist() if item.compress_type == ZIP_STORED]
            if sum(item.file_size for item in plain) > path.stat().st_size:
                return {}
            return {item.filename: archive.read(item) for item in plain}
    except (OSError, EOFError, BadZipFile, RuntimeError, ValueError):  # RuntimeError: encrypted, or another zip version
        return {}


def _probabilities(kept: bytes | None, slices: int) -> NDArray[np.float32] | None:
    """Return stored probabilities of this many slices, NaN where unknown; None if the bytes are invalid."""
    if kept is None or len(kept) != 4 * slices:
        return None
    values = np.frombuffer(kept, np.float32)
    return values if np.all(np.isnan(values) | ((values >= 0) & (values <= 1))) else None


def with_truth(paths: Sequence[Path], folder: Path | None) -> list[Path | None]:
    """Return for each features file its simulated recording; None if it is not found, not readable or has no truth.

    With a folder (--recordings), InputError if a recording is not found there or cannot be read.
    """
    origins = Origins("recording", folder)
    found = []
    for path in paths:
        with StageFile(path, "features") as features:
            recording = origins.find(features) if folder is None else origins.must_find(features, OTHER_FOLDER)
            found.append(recording if recording and _has_truth(features, recording, folder) else None)
    return found


def _has_truth(features: StageFile, path: Path, folder: Path | None) -> bool:
    try:
        with open_recording(path) as recording:
            if folder is not None:
                check_made_from(features, recording)
            return recording.header["id"] in features.header["parents"] and recording.has("truth/visible_slip_share")
    except EvetacError:
        if folder is not None:
            raise
        return False  # features can do without


def covariate_rows(paths: Sequence[Path], recordings: Sequence[Path | None], left_out: Collection[Path] = ()) -> Rows:
    """Return a row for each covariate that these labelled features provide, over the slips that are evaluated.

    recordings: those with truth, from `with_truth`. left_out: features whose labels abstain.
    """
    slips = []
    for path, simulated in zip(paths, recordings, strict=True):
        if path in left_out:
            continue
        if simulated is None:
            with StageFile(path, "features") as features:
                slip = _of_features(features)
        else:
            with open_recording(simulated) as recording:
                slip = covariates_of_truth(recording)
        slips += [slip] if slip is not None else []
    return summary(slips)


def missing_covariates(rows: Rows) -> list[str]:
    """Return a sentence on the covariates that the rows of a report lack; nothing if they have all."""
    present = {row["covariate"] for row in rows if "covariate" in row}
    missing = [words for words in WORDS.values() if words not in present]
    if not present or not missing:
        return []
    return [
        "Unknown for these slips (the truth of simulated recordings has most of them, see --recordings):"
        f" {'; '.join(missing)}."
    ]


def _of_features(features: StageFile) -> SlipCovariates | None:
    """Return the covariates from labels and events of features; None if the labels have no slip."""
    onset = int(features.read("onset_slice"))
    if onset < 0:
        return None

    def outside(start: int, stop: int) -> NDArray[np.int64]:
        counts: NDArray[np.int64] = features.read("events_outside", start, stop)
        return counts

    return of_labels(onset, features.read("label"), outside)
