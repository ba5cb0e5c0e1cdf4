"""What is known of a training before it begins: the memory that features take, and where its state is saved."""

from collections.abc import Sequence
from pathlib import Path

from evetac_cli.kernels.slip.architectures import (
    CHANNELS,
    EXTRAS,
    Architecture,
    ImageArchitecture,
    PluginImageArchitecture,
)
from evetac_cli.store.files import StageFile

# Features that are in memory together: 6.7 million slices of 56 dots, without directions, or half as many with them.
HELD_BYTES = 3_000_000_000


def series_bytes(file: StageFile, architecture: Architecture) -> int:
    """What the features that an architecture needs take in memory, for all slices of a features file."""
    if isinstance(architecture, ImageArchitecture):
        return 8 * file.length("image/start") + 5 * file.length("image/pixel") if file.has("image") else 0
    if isinstance(architecture, PluginImageArchitecture):
        held = file.has("gel_events")
        return 8 * file.length("gel_events/start") + 7 * file.length("gel_events/x") if held else 0
    slices, dots = file.contents()["displacement_px"][1]
    values = dots * (len(CHANNELS) if architecture.sees_direction else 2)
    return 4 * slices * (values + (len(EXTRAS) if architecture.extras else 0))


def group_parameters(memory_bytes: Sequence[int]) -> dict[str, int]:
    """What the recipe of a model says where its trajectories, which take so much each, are not in memory together."""
    return {"held_bytes": HELD_BYTES} if sum(memory_bytes) > HELD_BYTES else {}


def state_file(model: Path, number: int, networks: int) -> Path:
    """Where the state of a run is saved: NAME.model.part, or NAME.model.network1.part for the first of several."""
    name = "" if number == networks - 1 else f".network{number + 1}"
    return model.with_name(model.name.removesuffix(".h5") + name + ".part")
