"""Resolution of the simulation: time steps, gel nodes, and the camera's sub-steps and scans.

The settings come from a scene's table `[solver]` and from flags of `record` and `grasp`. `evaluate cost` measures the
run time and the accuracy of each setting.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from evetac_cli.errors import SceneError
from evetac_cli.sim.setup.tables import Table, read_table

LIFT_PITCH_MM = 1.45  # distance of the gel's nodes in a lift scene that states none
HALVINGS = 3  # most halvings of a 1 ms slice at the default tolerance: steps of 1/8 ms
MOST_HALVINGS = 7  # most halvings at any tolerance


@dataclass(frozen=True, kw_only=True)
class Solver(Table):
    """Resolution of the simulation; `evaluate cost` measures the run time and accuracy of each setting.

    Steps start at 1 ms and are halved until the tolerance is reached: HALVINGS times at most at the default tolerance,
    and once more for each halving of the tolerance. Steps are also halved until nodes slip one after the other (see
    sim.gel.adaptive). MOST_HALVINGS limits both.
    """

    #: largest estimated displacement error of a mechanical step; steps of 1 ms are halved until it is reached
    tolerance_um: Annotated[float, Meta(ge=0.001, le=1000)] = 0.2
    #: fixed mechanical step, instead of tolerance_um; 1 divided by a whole number
    step_ms: Annotated[float, Meta(ge=0.0001, le=1)] | None = None
    #: implicitness of the time step: 1 is implicit Euler; 0.5 is the trapezoidal rule, which rings after stick events
    theta: Annotated[float, Meta(ge=0.5, le=1)] = 0.51
    #: distance between neighbouring nodes of the gel; chosen by `grasp` if left out
    node_pitch_mm: Annotated[float, Meta(ge=0.05, le=5)] = 0.833
    #: number of straight segments of a dot's path within a slice
    camera_substeps: Annotated[int, Meta(ge=1, le=100)] = 1
    #: scans per ms of the simulated readout; the DVXplorer has 5
    scans_per_ms: Annotated[int, Meta(ge=1, le=1000)] = 5
    #: largest residual of the force balance in a step, relative to all forces
    residual: Annotated[float, Meta(ge=1e-12, le=0.01)] = 1e-06

    WRITTEN_WHOLE: ClassVar = True
    ALONE: ClassVar = ("step_ms", "tolerance_um")

    def __post_init__(self) -> None:
        """Check the fixed step; ValueError if it does not divide a slice."""
        if self.step_ms is not None and not self._divides_slice(self.step_ms):
            raise ValueError(f"step_ms: expected 1 ms divided by a whole number, found {self.step_ms}")

    @staticmethod
    def _divides_slice(step_ms: float) -> bool:
        steps = 1.0 / step_ms if math.isfinite(step_ms) and step_ms > 0.0 else math.nan
        return 1.0 <= steps <= 1e6 and abs(steps - round(steps)) <= 1e-6 * steps

    @property
    def fixed_steps(self) -> int | None:
        """Return the number of steps per slice if it is fixed, else None."""
        return None if self.step_ms is None else round(1.0 / self.step_ms)

    @property
    def halvings(self) -> int:
        """Return the largest number of halvings of a slice."""
        finer = math.ceil(math.log2(Solver.tolerance_um / self.tolerance_um) - 1e-9)
        return min(max(HALVINGS + finer, 0), MOST_HALVINGS)

    def nodes(self, pad_m: tuple[float, float]) -> tuple[int, int]:
        """Return the numbers of columns and rows of nodes on a pad of this size."""
        columns, rows = (max(2, round(side * 1e3 / self.node_pitch_mm)) for side in pad_m)
        return columns, rows


def with_given(solver: Solver, settings: Mapping[str, Any], where: str) -> Solver:
    """Replace a scene's settings with the given ones; SceneError if they are invalid.

    A given tolerance replaces a fixed step, and a given fixed step replaces a tolerance.
    """
    typed = read_table(Solver, settings, f"{where}: [solver]", error=SceneError)
    if "step_ms" in settings:
        solver = replace(solver, tolerance_um=Solver.tolerance_um)
    if "tolerance_um" in settings:
        solver = replace(solver, step_ms=None)
    return replace(solver, **{name: getattr(typed, name) for name in settings})
