"""How finely a scene is simulated: time steps, nodes of the gel, sub-steps and scans of the camera.

A scene's table `[solver]` and the flags of `record` and `grasp` choose; what each choice costs and gives is measured by
`evaluate cost`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from evetac_cli.checks import check_range
from evetac_cli.errors import InputError, SceneError
from evetac_cli.sim.setup.tables import number, read_table, whole

HALVINGS = 3  # of a slice at the default tolerance, at most: 1/8 ms
MOST_HALVINGS = 7


@dataclass(frozen=True, kw_only=True)
class Solver:
    """How finely the scene is simulated; what each setting costs and gives is measured by `evaluate cost`.

    From 1 ms steps are halved until the tolerance holds, HALVINGS times at most, and once more for each halving of the
    tolerance, or until nodes let go one after the other (see sim.gel.adaptive), MOST_HALVINGS times at most.
    """

    tolerance_um: float = number(
        "largest estimated error of the displacement in one mechanical step; steps are halved from 1 ms until it holds",
        0.001,
        1000,
        default=0.2,
    )
    step_ms: float | None = number(
        "fixed mechanical step instead, whatever its error; 1 divided by a whole number", 1e-4, 1, default=None
    )
    theta: float = number(
        "of the time step: 1 is implicit Euler, 0.5 the trapezoidal rule, which rings after stick events",
        0.5,
        1,
        default=0.51,
    )
    node_pitch_mm: float = number("distance of the gel's nodes", 0.05, 5, default=0.833)
    camera_substeps: int = whole("straight pieces of a dot's path within a slice", 1, 100, default=1)
    scans_per_ms: int = whole("scans of the simulated readout per ms; the DVXplorer has 5", 1, 100, default=5)
    residual: float = number("of the balance of forces in a step, as a share of all forces", 1e-12, 0.01, default=1e-6)

    RULES: ClassVar[Mapping[str, Any]] = {"not": {"required": ["tolerance_um", "step_ms"]}}
    WRITTEN_WHOLE: ClassVar = True
    ALONE: ClassVar = ("step_ms", "tolerance_um")

    def __post_init__(self) -> None:
        for name in ("tolerance_um", "node_pitch_mm", "residual"):
            check_range(name, getattr(self, name), above=True)
        check_range("theta", self.theta, 0.5, 1.0)
        check_range("camera_substeps", self.camera_substeps, 1)
        check_range("scans_per_ms", self.scans_per_ms, 1)
        if self.step_ms is not None and not self._divides_slice(self.step_ms):
            raise ValueError(f"step_ms: expected 1 ms divided by a whole number, found {self.step_ms}")

    @staticmethod
    def _divides_slice(step_ms: float) -> bool:
        steps = 1.0 / step_ms if math.isfinite(step_ms) and step_ms > 0.0 else math.nan
        return 1.0 <= steps <= 1e6 and abs(steps - round(steps)) <= 1e-6 * steps

    @property
    def fixed_steps(self) -> int | None:
        """Steps a slice, where their number is fixed."""
        return None if self.step_ms is None else round(1.0 / self.step_ms)

    @property
    def halvings(self) -> int:
        """How often a slice is halved at most."""
        finer = math.ceil(math.log2(Solver.tolerance_um / self.tolerance_um) - 1e-9)
        return min(max(HALVINGS + finer, 0), MOST_HALVINGS)

    def nodes(self, pad_m: tuple[float, float]) -> tuple[int, int]:
        """Columns and rows of nodes on a pad of this size."""
        columns, rows = (max(2, round(side * 1e3 / self.node_pitch_mm)) for side in pad_m)
        return columns, rows


def with_given(solver: Solver, given: Mapping[str, Any], where: str) -> Solver:
    """A scene's settings with those that are given in their place; SceneError for those that cannot be.

    A tolerance that is given takes the place of a fixed step, and a fixed step that of a tolerance.
    """
    if {"tolerance_um", "step_ms"} <= set(given):
        both = "a tolerance or a fixed step (tolerance_um, step_ms), not both"
        raise SceneError(f"[solver]: {both}", where=where)
    try:
        typed = read_table(Solver, dict(given), where)
    except InputError as error:
        message = f"[solver] {error.message}"
        raise SceneError(message, where=where, expected=error.expected, found=error.found, hint=error.hint) from None
    if "step_ms" in given:
        solver = replace(solver, tolerance_um=Solver.tolerance_um)
    if "tolerance_um" in given:
        solver = replace(solver, step_ms=None)
    return replace(solver, **{name: getattr(typed, name) for name in given})
