"""Planning of a training, without torch and numba: the memory for its features, the files of its saved state."""

from collections.abc import Sequence
from pathlib import Path

from evetac_cli.kernels.slip.architectures import (
    CHANNELS,
    Architecture,
    ImageArchitecture,
    MemoryArchitecture,
    PluginImageArchitecture,
    channels,
)
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Recipe

# Limit for features in memory: 6.7 million slices of 56 dots.
HELD_BYTES = 3_000_000_000


def series_bytes(file: StageFile, architecture: Architecture) -> int:
    """Return the memory, in bytes, for the features that an architecture needs from a features file."""
    if isinstance(architecture, ImageArchitecture):
        return 8 * file.length("image/start") + 5 * file.length("image/pixel") if file.has("image") else 0
    if isinstance(architecture, PluginImageArchitecture):
        has_events = file.has("gel_events")
        return 8 * file.length("gel_events/start") + 7 * file.length("gel_events/x") if has_events else 0
    slices, dots = file.contents()["displacement_px"][1]
    if isinstance(architecture, MemoryArchitecture):
        return slices // architecture.every * (4 * channels(architecture) + 1)
    return 4 * slices * dots * len(CHANNELS)


def group_parameters(memory_bytes: Sequence[int]) -> dict[str, int]:
    """Return the entry for a model's recipe if its trajectories do not fit in memory together; otherwise nothing."""
    return {"held_bytes": HELD_BYTES} if sum(memory_bytes) > HELD_BYTES else {}


def state_file(model: Path, recipe: Recipe, number: int, networks: int) -> Path:
    """Return the file of a network's saved state: NAME.model.RECIPE.part, with .network1 for the first of several.

    Its name has the first digits of the recipe's id, so that two trainings onto one output do not share their states.
    """
    name = "" if number == networks - 1 else f".network{number + 1}"
    return model.with_name(f"{model.name.removesuffix('.h5')}.{recipe.id[:8]}{name}.part")
