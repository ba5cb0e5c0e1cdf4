"""evaluate stability: stiff and extreme cases of one part."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.subject import SIMULATOR, Subject, SubjectTable, grouped
from evetac_cli.jobs import Row, Rows


@dataclass(frozen=True)
class EvaluateStability:
    """Run stiff and extreme cases of one part: each must stay in bounds or be refused with an error."""

    part: str = parameter(
        "sim",
        "Part to test. sim: the simulator. track: the dot tracker. grasp: the loop of detector, controller, gripper.",
        choices=("sim", "track", "grasp"),
        flag="PART",
    )
    seed: int = parameter(0, "Seed of the random cases.", low=0, high=2**31 - 1)
    full: bool = parameter(False, "Test more settings, longer runs and many more random cases; takes a few minutes.")
    strict: bool = parameter(
        False,
        "Exit with 1 if a case fails. Without this flag, failed cases are only printed and counted.",
        recipe=False,
    )


def _cases(rows: Rows, summary: Row) -> Rows:
    """Return a row per case: the quantity nearest to its bound or farthest beyond it; failed cases come first."""
    part = next((key for key in ("part", "preset", "controller") if rows and key in rows[0]), "case")
    worst = []
    for members in grouped(rows, (part, "case")):
        row = min(members, key=lambda row: (row["ok"], -(row["value"] or 0.0) / (row["bound"] or 1.0)))
        worst.append({**row, "part": row[part]})
    return sorted(worst, key=lambda row: bool(row["ok"]))


SUBJECT = Subject(
    "stability",
    EvaluateStability,
    "evaluate.stability.command",
    "",
    unit="rows",
    examples=("evetac evaluate stability sim", "evetac evaluate stability grasp --strict"),
    panel=SIMULATOR,
    title="Stiff and extreme cases",
    about="Each case must stay within a stated bound or be refused with a reason; cases that do neither come first.",
    tables=(
        SubjectTable(
            "Cases, each with the quantity nearest to its bound",
            _cases,
            ("part", "case", "ok", "quantity", "value", "bound", "unit", "outcome", "reason"),
        ),
    ),
)
