"""Resolution of the simulation: time steps, gel nodes, and the camera's sub-steps and scans.

The settings come from a scene's table `[solver]` and from flags of `record` and `grasp`. `evaluate cost` measures the
run time and the accuracy of each setting.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from evetac_cli.errors import InputError, SceneError
from evetac_cli.sim.setup.tables import number, read_table, whole

LIFT_PITCH_MM = 1.45  # distance of the gel's nodes in a lift scene that states none
HALVINGS = 3  # most halvings of a 1 ms slice at the default tolerance: steps of 1/8 ms
MOST_HALVINGS = 7  # most halvings at any tolerance


@dataclass(frozen=True, kw_only=True)
class Solver:
    """Resolution of the simulation; `evaluate cost` measures the run time and accuracy of each setting.

    Steps start at 1 ms and are halved until the tolerance is reached: HALVINGS times at most at the default tolerance,
    and once more for each halving of the tolerance. Steps are also halved until nodes slip one after the other (see
    sim.gel.adaptive). MOST_HALVINGS limits both.
    """

    tolerance_um: float = number(
        "largest estimated displacement error of a mechanical step; steps of 1 ms are halved until it is reached",
        0.001,
        1000,
        default=0.2,
    )
    step_ms: float | None = number(
        "fixed mechanical step, instead of tolerance_um; 1 divided by a whole number", 1e-4, 1, default=None
    )
    theta: float = number(
        "implicitness of the time step: 1 is implicit Euler; 0.5 is the trapezoidal rule, which rings after stick"
        " events",
        0.5,
        1,
        default=0.51,
    )
    node_pitch_mm: float = number(
        "distance between neighbouring nodes of the gel; chosen by `grasp` if left out", 0.05, 5, default=0.833
    )
    camera_substeps: int = whole("number of straight segments of a dot's path within a slice", 1, 100, default=1)
    scans_per_ms: int = whole("scans per ms of the simulated readout; the DVXplorer has 5", 1, 1000, default=5)
    residual: float = number(
        "largest residual of the force balance in a step, relative to all forces", 1e-12, 0.01, default=1e-6
    )

    RULES: ClassVar[Mapping[str, Any]] = {"not": {"required": ["tolerance_um", "step_ms"]}}
    WRITTEN_WHOLE: ClassVar = True
    ALONE: ClassVar = ("step_ms", "tolerance_um")

    def __post_init__(self) -> None:
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
    if {"tolerance_um", "step_ms"} <= set(settings):
        both = "expected a tolerance or a fixed step (tolerance_um, step_ms), not both"
        raise SceneError(f"[solver]: {both}", where=where)
    try:
        typed = read_table(Solver, dict(settings), where)
    except InputError as error:
        message = f"[solver] {error.message}"
        raise SceneError(message, where=where, expected=error.expected, found=error.found, hint=error.hint) from None
    if "step_ms" in settings:
        solver = replace(solver, tolerance_um=Solver.tolerance_um)
    if "tolerance_um" in settings:
        solver = replace(solver, step_ms=None)
    return replace(solver, **{name: getattr(typed, name) for name in settings})
