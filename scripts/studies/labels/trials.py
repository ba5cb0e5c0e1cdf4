"""Simulate slips in memory, as `evetac record` would write them, for scripts that label them without a file.

Events, commands and truth are those that `record` would write for the same object, seed, number and sensor.
"""

from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US, Events
from evetac_cli.sim.setup.object_file import seed_of
from evetac_cli.sim.setup.plan import plans
from evetac_cli.store.recordings.read import Recording
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial

KEPT = ("truth/slid_px", "truth/slip", "truth/every_node_slid_px")


class PlayedSlip:
    """A slip in memory, with the parts of a `Recording` that `label` reads."""

    def __init__(self, columns: Events, sensor: dict[str, Any], datasets: dict[str, Any], slices: int) -> None:
        """columns: all events. sensor, datasets: by their paths in a recording."""
        self.columns, self.datasets = columns, {**sensor, **datasets}
        self.starts: NDArray[np.int64] = np.searchsorted(columns.t, np.arange(slices + 1) * SLICE_US)
        self.path = Path("in memory")

    def __len__(self) -> int:
        return len(self.starts) - 1

    def has(self, name: str) -> bool:
        """Whether a dataset or a group of this name exists."""
        return any(path == name or path.startswith(f"{name}/") for path in self.datasets)

    def read(self, name: str, first: int | None = None, last: int | None = None) -> Any:
        """Return a dataset, or its rows [first, last)."""
        values = self.datasets[name]
        return values if first is None else values[first:last]

    def between(self, start: int, stop: int) -> Events:
        """Return all events of the slices [start, stop)."""
        return self.columns.part(int(self.starts[start]), int(self.starts[stop]))

    @property
    def frame_px(self) -> tuple[int, int]:
        """Width and height of the frame."""
        width, height = self.datasets["sensor/frame_px"].tolist()
        return width, height

    @property
    def window_px(self) -> tuple[int, int, int, int] | None:
        """The window of a cut gel."""
        window = self.datasets.get("sensor/window_px")
        return None if window is None else cast("tuple[int, int, int, int]", tuple(window.tolist()))

    @property
    def dot_xy_px(self) -> Any:
        """The dot grid."""
        return self.datasets["sensor/dot_xy_px"]

    def as_recording(self) -> Recording:
        """Return itself, for functions that require a file."""
        return cast(Recording, self)


def play_slip(number: int, seed: int, sensor: str = "evetac", trial: int = 0, scene: str = "slip") -> PlayedSlip:
    """Simulate the slip of `evetac record --scene SCENE --objects NUMBER --seed SEED --sensor SENSOR`."""
    plan = plans(scene, str(number), sensor, ("ramp",))[0].of_trial((seed, seed_of(number), trial))
    blocks: list[Events] = []
    rows: list[dict[str, Any]] = []

    def keep(events: Events, row: dict[str, Any]) -> None:
        blocks.append(events)
        rows.append(row)

    played = SimulatedTrial((), Path(), trial, seed, plan)
    devices, slices = simulated.play(played)
    try:
        for events, row in slices:
            keep(events, row)
    finally:
        devices.close()
    columns = Events(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))
    commands = [row for row in rows if "gripper/t_us" in row]
    gripper = {name: np.array([row[name] for row in commands]) for name in commands[0] if name.startswith("gripper/")}
    truth = {name: np.array([row[name] for row in rows]) for name in KEPT}
    return PlayedSlip(columns, dict(devices.camera.sensor), {**gripper, **truth}, len(rows))
