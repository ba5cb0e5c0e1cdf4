"""Whether the gel's nodes were fine enough for the slip of a simulated recording, from its truth.

Slip that is unstable because of friction grows in patches. Half of the shortest wavelength (sim.gel.friction) must span
FEWEST_NODES nodes. With fewer, the onset of slip depends on the grid, and so do all results that depend on the onset.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evetac_cli.store.files import StageFile

FEWEST_NODES = 4
NODES = "truth/slip_half_wavelength_nodes"
COLUMN = "slip_half_wavelength_nodes"  # of rows that depend on recordings
ROUNDED = (
    0.95  # a pad has a whole number of nodes, some 30 per side, so either pitch may differ by 2 % from the request
)
FINEST_MM = 0.05  # finest pitch of nodes that a scene may request
MOST_NAMED = 3


def fewest_nodes(half_wavelength_nodes: ArrayLike) -> float | None:
    """Return the fewest nodes that half the wavelength of unstable slip spans, over slices; None without such slip."""
    nodes = np.atleast_1d(np.asarray(half_wavelength_nodes, np.float64))
    nodes = nodes[np.isfinite(nodes)]
    return float(nodes.min()) if len(nodes) else None


def nodes_of(recording: StageFile) -> float | None:
    """Return this number for a recording; None if it is unknown, as for a real one."""
    return fewest_nodes(recording.read(NODES)) if recording.has(NODES) else None


def is_unresolved(nodes: float | None) -> bool:
    """Whether there are too few nodes; False if unknown."""
    return nodes is not None and nodes < FEWEST_NODES


def unresolved(nodes: float | None, node_pitch_mm: float | None) -> str | None:
    """Return a warning with a remedy if there are too few nodes; None if there are enough.

    node_pitch_mm: pitch of the simulated gel's nodes; None if unknown.
    """
    if nodes is None or not is_unresolved(nodes):
        return None
    words = f"onset of slip depends on the gel's grid: half the wavelength of unstable slip spans {nodes:.1f} nodes,"
    words += f" fewer than {FEWEST_NODES}; "
    if node_pitch_mm is None:
        return words + "record it with a finer --node-pitch-mm"
    finer_mm = resolving_mm(nodes, node_pitch_mm)
    if finer_mm < FINEST_MM:
        return (
            words
            + f"no --node-pitch-mm down to {FINEST_MM:g} resolves it: leave this recording out if its onset matters"
        )
    return words + f"record it with --node-pitch-mm {finer_mm:.2f} or finer"


def resolving_mm(nodes: float, node_pitch_mm: float) -> float:
    """Return the coarsest pitch, to 0.01 mm, that resolves slip which spans this number of nodes at another pitch."""
    return math.floor(100.0 * ROUNDED * node_pitch_mm * nodes / FEWEST_NODES) / 100.0


def once(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one warning for all rows of recordings that were just simulated: that of the coarsest."""
    warned = [row for row in rows if row.get("warning") and is_unresolved(row.get(COLUMN))]
    if not warned:
        return []
    coarsest = min(warned, key=lambda row: float(row[COLUMN]))
    return [f"{coarsest['warning']}{_of_several(len(warned), len(rows))}"]


def _of_several(warned: int, rows: int) -> str:
    return f" ({warned} of {rows} recordings need it; this is the coarsest)" if rows > 1 else ""


def resting_on(rows: Iterable[Mapping[str, Any]], name: str = "file") -> list[str]:
    """Return a sentence on rows from recordings whose slip the nodes did not resolve; none if all were resolved."""
    coarse = [row for row in rows if is_unresolved(row.get(COLUMN))]
    if not coarse:
        return []
    examples = ", ".join(f"{row[name]} {row[COLUMN]:.1f}" for row in coarse[:MOST_NAMED])
    examples += f" and {len(coarse) - MOST_NAMED} more" if len(coarse) > MOST_NAMED else ""
    which = f"{len(coarse)} recording{'s' if len(coarse) > 1 else ''} ({examples}; half its wavelength should span"
    return [
        f"The gel's nodes do not resolve the slip of {which} {FEWEST_NODES} nodes): their onsets depend on the grid."
        " Record them with a finer --node-pitch-mm."
    ]
