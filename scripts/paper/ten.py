"""The ten rows of README and of docs/evidence/paper.md: of each topic of the paper one figure, by the paper's method.

A row is one of rows.json; beside it stands how well evetac's own method does on the same trials, if there is one.
"""

from pathlib import Path
from string import Formatter
from typing import NamedTuple

from evetac_cli.jobs import Row
from scripts.paper.rows import by_number, read, row_of

SLIPS = "{trajectories} slips, {seeds} trainings"
GRASPS = "{trials} grasps"


class Own(NamedTuple):
    """Evetac's own method: the row of the same table that differs in these values, and the cell of its figure."""

    select: Row
    cell: str


class TenRow(NamedTuple):
    """One of the ten rows. number: of rows.json; n: format string over the row of its table."""

    number: str
    what: str
    n: str
    own: Own | None = None


TEN = (
    TenRow(
        "20a", "all dots back in place after something rubbed over the gel", "{trajectories} trials",
        Own({"preset": "stable"}, "{consistent_share:.2f}"),
    ),
    TenRow(
        "29p", "tone identified in 2 s, five tones from 100 to 498 Hz", "{windows} windows",
        Own({"method": "default"}, "{share:.2f}"),
    ),
    TenRow("36a", "bytes per second over an RGB sensor's", "{trajectories} trials"),
    TenRow(
        "41c", "error of the shear force Fx by a network [N]", "{trajectories} trials, {models} trainings",
        Own({"tracker": "stable"}, "{mae_n_x:.2f}"),
    ),
    TenRow("77a", "slip detected in time, known objects", SLIPS),
    TenRow("79b", "slip detected in time, 10 ms ahead, unseen objects", SLIPS),
    TenRow("82a", "... first detection in the last 10 ms before slip", "{slips} slips, {seeds} trainings"),
    TenRow("84a", "time of the network [ms]; here on a CPU, in the paper on a GPU", "one core"),
    TenRow(
        "91a", "object lifted and kept", GRASPS,
        Own({"evaluation": "grasps-load-proportional", "setting": "load-proportional"}, "{success:.2f}"),
    ),
    TenRow(
        "98c", "object kept when 100 g fall on it", GRASPS,
        Own(
            {"evaluation": "grasp-robustness-load-proportional", "setting": "load-proportional, drop-100g"},
            "{success:.2f}",
        ),
    ),
)  # fmt: skip


def needed(table: str) -> set[str]:
    """Return the fields of a table that the ten rows show, which are therefore stored with it."""
    entries = by_number(read()["rows"])
    fields = set()
    for row in (one for one in TEN if entries[one.number]["table"] == table):
        texts = [row.n, *([row.own.cell] if row.own else [])]
        fields |= {name for text in texts for _, name, _, _ in Formatter().parse(text) if name}
        fields |= set(row.own.select if row.own else ())
    return fields


def counted(row: TenRow, entry: Row, results: Path) -> str:
    """Return how many trials evetac's figure is from, in words."""
    return row.n.format(**row_of(results, entry["table"], entry["row"])[1])


def by_own_method(row: TenRow, entry: Row, results: Path) -> str:
    """Return the figure of evetac's own method; empty without one."""
    if row.own is None:
        return ""
    return row.own.cell.format(**row_of(results, entry["table"], entry["row"] | row.own.select)[1])
