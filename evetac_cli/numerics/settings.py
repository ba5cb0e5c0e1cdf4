"""Settings of a simulation that a user can choose, as rows of a table: what they are called, and the flags to copy."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from evetac_cli.params.parameter import flag_of
from evetac_cli.params.trials import SOLVER_OPTIONS, Trials

FLAGS = {item.name: flag_of(item) for item in fields(Trials) if item.name in SOLVER_OPTIONS}


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
        return " ".join(f"{FLAGS[key]} {value:g}" for key, value in self.solver.items())


def line(name: str, key: str, values: tuple[float, ...], unit: str = "", **others: float) -> list[Setting]:
    """The settings of one line: a key of the table [solver] with each of these values, and others beside it."""
    return [Setting(name, f"{value:g} {unit}".rstrip(), {key: value, **others}) for value in values]
