"""The networks of one training, trained one after the other or each as a task, and resumed after an interruption.

The state of each network is kept in a file next to the model, a numpy archive written every half minute. Networks that
another process finished are read from there.
"""

import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evetac_cli.jobs import Progress
from evetac_cli.kernels.slip import sampling
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.sampling import PoolSizes, SampleGroups, Size, SlipSamples, drawn_groups
from evetac_cli.stages.related_files import Fold
from evetac_cli.stages.slip_detectors import read_pool_sizes, read_trajectory
from evetac_cli.stages.train import plan
from evetac_cli.store.hdf5.disk import taking_the_place_of
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.layout.rules import named_architecture

if TYPE_CHECKING:  # torch takes more than a second to import
    from evetac_cli.kernels.slip.training import Preset, SlipTraining, TrainingState

SAVE_S = 30.0  # interval of saving: the most work lost when a run is interrupted


@dataclass(eq=False)
class Networks:
    """All networks of a model, numbered: those of the first fold, of the second, and so on."""

    model: Path  # file of the model
    inputs: tuple[Path, ...]
    memory_bytes: Sequence[int]  # memory for the features of each input
    folds: Sequence[Fold]
    recipe: Recipe  # with all settings of the training
    shape: tuple[int, int]  # rows and columns of dots
    start: Sequence[dict[str, NDArray[np.float32]]] | None  # initial weights of each network of a fold
    _gathered: dict[int, SampleGroups] = field(default_factory=dict, init=False)  # of the last requested fold

    @property
    def count(self) -> int:
        """Number of networks."""
        return len(self.folds) * int(self.recipe.parameters["networks"])

    @property
    def preset(self) -> "Preset":
        """The training preset of all networks."""
        from evetac_cli.kernels.slip import training

        parameters = self.recipe.parameters
        preset = training.PRESETS[parameters["preset"]] if self.start is None else training.ADAPT
        return training.with_true_slip_share(preset) if parameters["learn_true_slip_share"] else preset

    def train(self, number: int, progress: Progress) -> tuple["SlipTraining", int | None]:
        """Train a network, or continue from its saved state; return the result and the step of that state.

        The step is None without a saved state, or if the state was that of a finished network. If there are several
        networks, each final state is saved. The random numbers of the last network do not depend on their number.
        """
        from evetac_cli.kernels.slip import training

        parameters, place = self.recipe.parameters, plan.state_file(self.model, self.recipe, number, self.count)
        start = None if self.start is None else self.start[number % parameters["networks"]]
        preset = self.preset
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
        result = training.train(
            self._groups_of(number // parameters["networks"], progress),
            preset,
            # (0, 0) would be the same as 0, since numpy pads the words of a seed with zeros.
            np.random.default_rng(seed if number == self.count - 1 else (seed, number + 1)),
            parameters["epochs"],
            parameters["max_steps"],
            on_progress=lambda step, steps: progress(number * steps + step, self.count * steps),
            on_save=save,
            device=parameters["device"],
            resume_from=saved,
            start=start,
        )
        if self.count > 1:
            _write(place, self.recipe, result.state)
        return result, None if saved is None else int(saved["step"])

    def remove_states(self) -> None:
        """Remove the saved states."""
        for number in range(self.count):
            plan.state_file(self.model, self.recipe, number, self.count).unlink(missing_ok=True)

    def _groups_of(self, fold: int, progress: Progress) -> SampleGroups:
        """Return the training samples of a fold."""
        if fold not in self._gathered:
            self._gathered.clear()
            self._gathered[fold] = self._groups(self.folds[fold].trained_on, progress)
        return self._gathered[fold]

    def _groups(self, numbers: Sequence[int], progress: Progress) -> SampleGroups:
        """Return the samples of these inputs: all together if memory allows, otherwise in groups drawn by the seed."""
        if sum(self.memory_bytes[number] for number in numbers) <= plan.HELD_BYTES:
            return SampleGroups.alone(self._samples(numbers, progress))
        sizes = []
        for done, number in enumerate(numbers):
            progress(done, len(numbers), "labels read")
            sizes.append(Size(self.memory_bytes[number], self._pool_sizes(number)))
        # a different generator than those of the networks, which are seeded with its children
        index_groups = drawn_groups(sizes, plan.HELD_BYTES, np.random.default_rng(self.recipe.parameters["seed"]))
        groups = [[numbers[index] for index in group] for group in index_groups]
        steps = [PoolSizes(*np.sum([sizes[index].samples for index in group], axis=0)).steps for group in index_groups]
        return SampleGroups(steps, lambda group: self._samples(groups[group], progress))

    def _pool_sizes(self, number: int) -> PoolSizes:
        parameters = self.recipe.parameters
        return read_pool_sizes(self.inputs[number], named_architecture(parameters["model"]), parameters["horizon_ms"])

    def _samples(self, numbers: Sequence[int], progress: Progress) -> SlipSamples:
        """Return the samples of these inputs."""
        parameters = self.recipe.parameters
        architecture = named_architecture(parameters["model"])

        def trajectories() -> Iterator[Trajectory]:
            for done, number in enumerate(numbers):
                progress(done, len(numbers), "files read")
                yield read_trajectory(
                    self.inputs[number], architecture, true_slip_share=parameters["learn_true_slip_share"]
                )

        return sampling.gather(trajectories(), architecture, *self.shape, parameters["horizon_ms"])


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
