"""The networks of one training, trained one after the other or each as a task, and resumed after an interruption.

The state of each network is kept in a file next to the model, a numpy archive written every half minute. Networks that
another process finished are read from there.
"""

import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli import plugins
from evetac_cli.errors import InputError
from evetac_cli.jobs import Progress
from evetac_cli.kernels.slip import sampling
from evetac_cli.kernels.slip.architectures import Architecture, MemoryArchitecture
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.metrics import LAST_CHECKPOINTS, Prediction
from evetac_cli.kernels.slip.sampling import PoolSizes, SampleGroups, SlipSamples, TrajectorySize, drawn_groups
from evetac_cli.stages.related_files import Fold
from evetac_cli.stages.slip_detectors import predict, read_pool_sizes, read_trajectory
from evetac_cli.stages.train import plan
from evetac_cli.store.hdf5.disk import taking_the_place_of
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.layout.rules import named_architecture

if TYPE_CHECKING:  # torch takes more than a second to import
    from evetac_cli.kernels.slip.training import Checkpoint, Preset, SlipTraining, TrainingState

Weights = dict[str, NDArray[np.float32]]
COMPARED = 64  # inputs of a file on which the two forms of a plug-in's network are compared
# Probability. evetac's networks on dots differ by at most 6e-7 after training, and by 4e-6 with random weights of
# standard deviation 0.3, over inputs of three simulated slips.
FORMS_AGREE = 1e-4
SAVE_S = 30.0  # interval of saving: the most work lost when a run is interrupted


class TrainedFolds(NamedTuple):
    """The trained network of the last fold, which is the detector, and what was predicted for the folds' trajectories.

    predictions: of the last checkpoints, for the trajectories that each fold leaves out. resumed_at: the step of the
    saved state from which the first network with one continued.
    """

    network: "SlipTraining"
    predictions: list[list[Prediction]]
    resumed_at: int | None

    @property
    def checkpoints(self) -> list["Checkpoint"]:
        """The last checkpoints of the detector."""
        return self.network.checkpoints[-LAST_CHECKPOINTS:]

    def figures(self) -> dict[str, Any]:
        """Return the figures to print."""
        return {
            "steps": self.network.steps,
            "steps_of_all_epochs": self.network.steps_planned,
            "stopped_early": self.network.cut,
            "resumed_at_step": self.resumed_at,
            "loss": float(self.network.curve_loss[-1]),
        }


def prepare_torch(device: str) -> None:
    """Let torch use one thread; InputError if a GPU is wanted and there is none."""
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("torch finds no GPU", where="--device", expected="cpu", found=device)
    torch.set_num_threads(1)  # the networks are too small for several threads, and results depend on their number


@dataclass(eq=False)
class Networks:
    """The networks of a model, one for each fold, numbered like these."""

    model: Path  # file of the model
    inputs: tuple[Path, ...]
    memory_bytes: Sequence[int]  # memory for the features of each input
    folds: Sequence[Fold]
    recipe: Recipe  # with all settings of the training
    shape: tuple[int, int]  # rows and columns of dots
    start: Weights | None  # initial weights, of a model to adapt

    @property
    def preset(self) -> "Preset":
        """The training preset of all networks."""
        from evetac_cli.kernels.slip import training

        parameters = self.recipe.parameters
        has_memory = isinstance(self.architecture, MemoryArchitecture)
        if self.start is not None:
            preset = training.ADAPT_MEMORY if has_memory else training.ADAPT
        else:
            preset = training.MEMORY if has_memory else training.PRESETS[parameters["preset"]]
        return training.with_true_slip_share(preset) if parameters["learn_true_slip_share"] else preset

    @property
    def architecture(self) -> Architecture:
        """The architecture of all networks."""
        return named_architecture(self.recipe.parameters["model"])

    def train_folds(self, headers: Sequence[Header], progress: Progress) -> TrainedFolds:
        """Train all networks; let each predict what its fold leaves out. headers: of all inputs."""
        folds = [self._train_fold(number, headers, progress) for number in range(len(self.folds))]
        predictions = [list(chain(*each)) for each in zip(*(fold.predictions for fold in folds), strict=True)]
        resumed_at = next((fold.resumed_at for fold in folds if fold.resumed_at is not None), None)
        return folds[-1]._replace(predictions=predictions, resumed_at=resumed_at)

    def _train_fold(self, number: int, headers: Sequence[Header], progress: Progress) -> TrainedFolds:
        from evetac_cli.kernels.slip import onnx_graphs
        from evetac_cli.kernels.slip.detector import Detector

        network, resumed_at = self.train(number, progress)
        checkpoints = network.checkpoints[-LAST_CHECKPOINTS:]
        graphs = [onnx_graphs.build(self.architecture, each.weights, *self.shape) for each in checkpoints]
        detectors = [Detector(graph, self.architecture) for graph in graphs]
        left_out, horizon_ms = self.folds[number].evaluated_on, self.recipe.parameters["horizon_ms"]
        predictions: list[list[Prediction]] = [[] for _ in detectors]
        for done, index in enumerate(left_out):
            progress(done, len(left_out), "files evaluated")
            self._require_same_forms(checkpoints[-1].weights, self.inputs[index])
            trajectory = self._trajectory(index)
            judged = predict(detectors, trajectory, headers[index], horizon_ms)
            for of_detector, prediction in zip(predictions, judged, strict=True):
                of_detector.append(prediction)
        return TrainedFolds(network, predictions, resumed_at)

    def _require_same_forms(self, weights: Weights, path: Path) -> None:
        """Raise InputError if a plug-in's network computes another probability in torch than as an ONNX graph.

        path: a file whose inputs are used to compare.
        """
        architecture = self.architecture
        plugin = plugins.by_name(plugins.NETWORKS, architecture.name)
        if plugin is None:
            return
        from evetac_cli.kernels.slip import inputs, networks

        series = read_trajectory(path, architecture).series
        slices = inputs.length(series)
        if slices < architecture.history:
            return
        ends = np.unique(np.linspace(architecture.history - 1, slices - 1, COMPARED).astype(np.int64))
        batch = inputs.at(architecture, series, ends)
        difference = networks.difference_of_forms(architecture, weights, *self.shape, batch)
        if not difference <= FORMS_AGREE:
            found = f"for inputs from {path}, torch and ONNX return probabilities up to {difference:.3g} apart"
            raise plugin.error(f"{found}: its `hidden` and `add_layers` are not the same network")

    def train(self, number: int, progress: Progress) -> tuple["SlipTraining", int | None]:
        """Train a network, or continue from its saved state; return the result and the step of that state.

        The step is None without a saved state, or if the state was that of a finished network. If there are several
        networks, each final state is saved. The random numbers of the last network do not depend on their number. A
        network with memory is not saved before its end.
        """
        from evetac_cli.kernels.slip import memory_training, training

        parameters, preset, count = self.recipe.parameters, self.preset, len(self.folds)
        place = plan.state_file(self.model, self.recipe, number, count)
        saved = _read(place, self.recipe)
        if saved is not None and (whole := training.ended(preset, saved)) is not None:
            return whole, None
        written = time.monotonic()

        def save(state: Callable[[], "TrainingState"]) -> None:
            nonlocal written
            if time.monotonic() - written >= SAVE_S:
                _write(place, self.recipe, state())
                written = time.monotonic()

        seed = parameters["seed"]
        # (0, 0) would be the same as 0, since numpy pads the words of a seed with zeros.
        rng = np.random.default_rng(seed if number == count - 1 else (seed, number + 1))
        lengths: dict[str, Any] = {name: parameters[name] for name in ("epochs", "max_steps")}
        common: dict[str, Any] = lengths | {"device": parameters["device"], "start": self.start}
        common["on_progress"] = lambda step, steps: progress(number * steps + step, count * steps)
        trained_on = self.folds[number].trained_on
        if isinstance(self.architecture, MemoryArchitecture):
            trajectories = self._trajectories(trained_on, progress)
            contacts = memory_training.gather(trajectories, self.architecture, parameters["horizon_ms"])
            result = memory_training.train(contacts, preset, rng, **common)
        else:
            groups = self._groups(trained_on, progress)
            result = training.train(groups, preset, rng, **common, on_save=save, resume_from=saved)
        if count > 1:
            _write(place, self.recipe, result.state)
        return result, None if saved is None else int(saved["step"])

    def remove_states(self) -> None:
        """Remove the saved states."""
        for number in range(len(self.folds)):
            plan.state_file(self.model, self.recipe, number, len(self.folds)).unlink(missing_ok=True)

    def _groups(self, numbers: Sequence[int], progress: Progress) -> SampleGroups:
        """Return the samples of these inputs: all together if memory allows, otherwise in groups drawn by the seed."""
        if sum(self.memory_bytes[number] for number in numbers) <= plan.HELD_BYTES:
            return SampleGroups.alone(self._samples(numbers, progress))
        sizes = []
        for done, number in enumerate(numbers):
            progress(done, len(numbers), "labels read")
            sizes.append(TrajectorySize(self.memory_bytes[number], self._pool_sizes(number)))
        # a different generator than those of the networks, which are seeded with its children
        index_groups = drawn_groups(sizes, plan.HELD_BYTES, np.random.default_rng(self.recipe.parameters["seed"]))
        groups = [[numbers[index] for index in group] for group in index_groups]
        steps = [PoolSizes(*np.sum([sizes[index].samples for index in group], axis=0)).steps for group in index_groups]
        return SampleGroups(steps, lambda group: self._samples(groups[group], progress))

    def _pool_sizes(self, number: int) -> PoolSizes:
        return read_pool_sizes(self.inputs[number], self.architecture, self.recipe.parameters["horizon_ms"])

    def _samples(self, numbers: Sequence[int], progress: Progress) -> SlipSamples:
        """Return the samples of these inputs."""
        horizon_ms = self.recipe.parameters["horizon_ms"]
        return sampling.gather(self._trajectories(numbers, progress), self.architecture, *self.shape, horizon_ms)

    def _trajectories(self, numbers: Sequence[int], progress: Progress) -> Iterator[Trajectory]:
        for done, number in enumerate(numbers):
            progress(done, len(numbers), "files read")
            yield self._trajectory(number)

    def _trajectory(self, number: int) -> Trajectory:
        knows_share = self.recipe.parameters["learn_true_slip_share"]
        return read_trajectory(self.inputs[number], self.architecture, true_slip_share=knows_share)


def _read(path: Path, recipe: Recipe) -> "TrainingState | None":
    """Return the saved state of a run of this recipe; None if it is missing, damaged, or of another recipe."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
    return arrays if str(arrays.pop("recipe", "")) == recipe.id else None


def _write(path: Path, recipe: Recipe, state: "TrainingState") -> None:
    """Save the state of a run atomically."""
    with taking_the_place_of(path) as temporary, temporary.open("wb") as file:
        np.savez(file, recipe=np.array(recipe.id), **state)  # type: ignore[arg-type]
