"""Settings of a simulation that a user can choose, as rows of a table: the flags to copy, and the plan they lead to."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Setting:
    """One choice: the line of the picture that it lies on, its place on that line, and the scene's table [solver]."""

    line: str
    value: str = ""
    solver: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What stands in the column `setting`: `fixed step, 0.25 ms`."""
        return f"{self.line}, {self.value}" if self.value else self.line

    @property
    def flags(self) -> str:
        """The flags of `record` and `grasp` that choose it: `--step-ms 0.25`; empty where nothing is chosen."""
        return " ".join(f"--{key.replace('_', '-')} {value:g}" for key, value in self.solver.items())

    def plan(self, plan: Mapping[str, Any]) -> dict[str, Any]:
        """A trial's plan with this choice in its scene, as the flags would make it."""
        if not self.solver:
            return dict(plan)
        scene = plan["scene"]
        return {**plan, "scene": {**scene, "solver": {**scene.get("solver", {}), **self.solver}}}


def line(name: str, key: str, values: tuple[float, ...], unit: str = "") -> list[Setting]:
    """The settings of one line: a key of the table [solver] with each of these values."""
    return [Setting(name, f"{value:g} {unit}".rstrip(), {key: value}) for value in values]
