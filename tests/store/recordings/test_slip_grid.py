"""Whether the gel's nodes resolve slip: numbers by hand, words, and a pitch that resolves it."""

import numpy as np
import pytest

from evetac_cli.sim.setup.scene import Solver
from evetac_cli.store.recordings.slip_grid import COLUMN, fewest_nodes, once, unresolved


def test_fewest_nodes() -> None:
    """Assert that slices without unstable slip do not count, and that there may be none that does."""
    assert fewest_nodes(np.array([np.nan, 6.5, np.inf, 3.25], np.float32)) == 3.25
    assert fewest_nodes(5.0) == 5.0
    assert fewest_nodes(np.array([np.nan])) is fewest_nodes(np.empty(0)) is None


@pytest.mark.parametrize("side_mm", [17.0, 20.3, 25.0])
@pytest.mark.parametrize("nodes", [0.6, 1.7, 2.3, 3.99])
def test_the_pitch_that_is_named_resolves_it(nodes: float, side_mm: float) -> None:
    """Assert that with that pitch, on a pad of whole nodes, half the same wavelength spans four nodes or more."""
    usual = Solver()
    columns, _ = usual.nodes((1e-3 * side_mm, 1e-3 * side_mm))
    half_mm = nodes * side_mm / columns
    words = unresolved(nodes, usual.node_pitch_mm)
    assert words is not None
    finer = Solver(node_pitch_mm=float(words.split("--node-pitch-mm ")[1].split()[0]))
    columns, _ = finer.nodes((1e-3 * side_mm, 1e-3 * side_mm))
    assert half_mm / (side_mm / columns) >= 4.0


def test_what_no_pitch_resolves() -> None:
    """Assert that an object is to be left out where no pitch that is allowed will do, and words without a pitch."""
    assert "leave this recording out" in (unresolved(0.1, 0.833) or "")
    assert (unresolved(2.0, None) or "").endswith("record it with a finer --node-pitch-mm")


def test_a_warning_is_said_once() -> None:
    """Assert one line for all recordings, that of the coarsest, and none where all are resolved."""

    def row(nodes: float | None) -> dict[str, object]:
        return {COLUMN: nodes, "warning": unresolved(nodes, 0.833)}

    assert once([row(None), row(5.0), {"output": "up to date"}]) == []
    assert once([row(2.5)]) == [unresolved(2.5, 0.833)]
    assert once([row(2.5), row(1.5), row(7.0)]) == [
        f"{unresolved(1.5, 0.833)} (2 of 3 recordings need it; this is the coarsest)"
    ]
