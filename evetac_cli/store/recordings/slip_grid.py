"""Whether the gel's nodes were fine enough for the slip of a simulated recording: from its truth, in number and words.

Slip that friction makes unstable grows in patches. Half the wavelength of the shortest (sim.gel.friction) has to span
FEWEST_NODES nodes: below that, the onset of slip depends on the grid, and figures that rest on it do, too.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evetac_cli.store.files import StageFile

FEWEST_NODES = 4
NODES = "truth/slip_half_wavelength_nodes"
COLUMN = "slip_half_wavelength_nodes"  # of rows that rest on recordings
ROUNDED = 0.95  # a pad has a whole number of nodes, some thirty a side: either pitch may be 2 % off what was asked for
FINEST_MM = 0.05  # pitch of nodes that a scene may ask for
MOST_NAMED = 3


def fewest_nodes(half_wavelength_nodes: ArrayLike) -> float | None:
    """Fewest nodes that half the wavelength of unstable slip spans, over slices; None where no slip is unstable."""
    nodes = np.atleast_1d(np.asarray(half_wavelength_nodes, np.float64))
    nodes = nodes[np.isfinite(nodes)]
    return float(nodes.min()) if len(nodes) else None


def nodes_of(recording: StageFile) -> float | None:
    """The same of a recording; None where it does not know, as a real one."""
    return fewest_nodes(recording.read(NODES)) if recording.has(NODES) else None


def is_unresolved(nodes: float | None) -> bool:
    """Whether so few nodes are too few; unknown is not."""
    return nodes is not None and nodes < FEWEST_NODES


def unresolved(nodes: float | None, node_pitch_mm: float | None) -> str | None:
    """What is wrong with so few nodes, and what to do, in words; None where they are enough.

    node_pitch_mm: of the gel that was simulated, None where it is not known.
    """
    if nodes is None or not is_unresolved(nodes):
        return None
    words = f"onset of slip depends on the gel's grid: half the wavelength of unstable slip spans {nodes:.1f} nodes,"
    words += f" of {FEWEST_NODES} at least; "
    if node_pitch_mm is None:
        return words + "record it with a finer --node-pitch-mm"
    finer_mm = resolving_mm(nodes, node_pitch_mm)
    if finer_mm < FINEST_MM:
        return (
            words
            + f"no --node-pitch-mm down to {FINEST_MM:g} resolves it: leave this recording out where its onset matters"
        )
    return words + f"record it with --node-pitch-mm {finer_mm:.2f} or finer"


def resolving_mm(nodes: float, node_pitch_mm: float) -> float:
    """The coarsest pitch in mm, in hundredths, that resolves slip which spans so many nodes of another pitch."""
    return math.floor(100.0 * ROUNDED * node_pitch_mm * nodes / FEWEST_NODES) / 100.0


def once(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The warnings of rows of recordings that were just simulated, in one line; that of the coarsest stands for all."""
    warned = [row for row in rows if row.get("warning") and is_unresolved(row.get(COLUMN))]
    if not warned:
        return []
    coarsest = min(warned, key=lambda row: float(row[COLUMN]))
    return [f"{coarsest['warning']}{_of_several(len(warned), len(rows))}"]


def _of_several(warned: int, rows: int) -> str:
    return f" ({warned} of {rows} recordings need it; this is the coarsest)" if rows > 1 else ""


def resting_on(rows: Iterable[Mapping[str, Any]], name: str = "file") -> list[str]:
    """A sentence on those rows that rest on recordings whose slip the nodes did not resolve; none where all did."""
    coarse = [row for row in rows if is_unresolved(row.get(COLUMN))]
    if not coarse:
        return []
    named = ", ".join(f"{row[name]} {row[COLUMN]:.1f}" for row in coarse[:MOST_NAMED])
    named += f" and {len(coarse) - MOST_NAMED} more" if len(coarse) > MOST_NAMED else ""
    which = f"{len(coarse)} recording{'s' if len(coarse) > 1 else ''} ({named}; half its wavelength should span"
    return [
        f"The gel's nodes do not resolve the slip of {which} {FEWEST_NODES} nodes): their onsets hang on the grid."
        " Record them with a finer --node-pitch-mm."
    ]
