"""Rows of a stability suite: what became of every case, in words, and the figures of the suite."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]


@dataclass(frozen=True)
class Rows:
    """How the rows of a suite are made: all have the same figures, which are None where a case does not have them."""

    figures: tuple[str, ...]

    def row(self, case: str, ok: bool, outcome: str, **found: float | int | None) -> Row:
        """A row."""
        return {"case": case, "ok": ok, "outcome": outcome, **{name: found.get(name) for name in self.figures}}

    def in_words(self, case: str, run: Callable[[], Row]) -> Row:
        """The row of a case, also where it raises: refused in words is ok, any other failure is not."""
        try:
            return run()
        except ValueError as error:
            return self.row(case, bool(str(error)), f"refused: {error}")
        except Exception as error:  # a suite has to survive what it looks for
            return self.row(case, False, f"failed: {type(error).__name__}: {error}")

    def refusal(self, case: str, call: Callable[[], object]) -> Row:
        """Ok where the call is refused with a ValueError that says why."""

        def accepted() -> Row:
            call()
            return self.row(case, False, "accepted")

        return self.in_words(case, accepted)


SIMULATOR = Rows(("sweeps_mean", "sweeps_most", "residual_most", "energy_gained_j"))  # of gel, gripper and camera
