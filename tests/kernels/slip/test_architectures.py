"""The table of architectures: the paper's rows, and which rows cannot be."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest

from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    EVENTS_A_RIM,
    SHEAR_MODULUS_PA,
    UNKNOWN_SENSITIVITY,
    Architecture,
    ChannelView,
    DotArchitecture,
    ImageArchitecture,
    Sensitivity,
    to_one_sensor,
)
from evetac_cli.kernels.slip.sampling import train_cut_ms

# the paper's table of model configurations: history, l_i, l_fc1, l_fc2
PAPER_ROWS = {
    "no-hist": (1, 2, 10, 4),
    "hist10": (10, 20, 12, 4),
    "events-only": (10, 10, 8, 4),
    "disp-only": (10, 10, 8, 4),
    "hist20": (20, 40, 20, 8),
    "down5": (50, 20, 12, 4),
    "fast-slow": (50, 30, 15, 8),
}


def test_module_needs_no_torch() -> None:
    """Assert that grasp can learn a model's history without torch."""
    code = "import sys, evetac_cli.kernels.slip.architectures; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", PAPER_ROWS)
def test_dot_models_are_the_papers(name: str) -> None:
    """Assert that each dot model of the paper is one row of the table, with the paper's history and widths."""
    row = ARCHITECTURES[name]
    assert isinstance(row, DotArchitecture)
    assert (row.history, row.inputs_per_dot, row.fc1, row.fc2) == PAPER_ROWS[name]
    assert row.every == (5 if name == "down5" else 1)


@pytest.mark.parametrize(("name", "history"), [("no-hist-img", 1), ("hist10-img", 10)])
def test_image_models_are_the_papers(name: str, history: int) -> None:
    """Assert that the baselines see 540 x 480 px with the paper's pools, and their small forms 90 x 80."""
    row, small = ARCHITECTURES[name], ARCHITECTURES[name + "-6x6"]
    assert isinstance(row, ImageArchitecture)
    assert isinstance(small, ImageArchitecture)
    assert row.input_shape == (history, 480, 540)
    assert row.pools == ((3, 3), (3, 3), (4, 4), (9, 7))
    assert small.input_shape == (history, 80, 90)


@pytest.mark.parametrize("row", ARCHITECTURES.values(), ids=ARCHITECTURES)
def test_train_cut_follows_history(row: Architecture) -> None:
    """Assert that longer histories train on more of the slip, with the paper's three values."""
    assert train_cut_ms(row.history) == {1: 15, 10: 15, 20: 20, 50: 50}[row.history]


def test_features_are_scaled_to_one_sensor() -> None:
    """Assert that half the threshold counts half its events and that half the modulus moves half as far."""
    assert to_one_sensor(Sensitivity(EVENTS_A_RIM, SHEAR_MODULUS_PA)) == (1.0, 1.0)
    assert to_one_sensor(UNKNOWN_SENSITIVITY) == (1.0, 1.0)
    assert to_one_sensor(Sensitivity(2 * EVENTS_A_RIM)) == (1.0, 0.5)
    assert to_one_sensor(Sensitivity(None, SHEAR_MODULUS_PA / 2)) == (0.5, 0.5)
    assert to_one_sensor(Sensitivity(2 * EVENTS_A_RIM, SHEAR_MODULUS_PA / 2)) == (0.5, 0.25)


HIST10 = DotArchitecture("hist10", (ChannelView("distance", 10), ChannelView("events", 10)), 12, 4)


@pytest.mark.parametrize(
    "change",
    [
        {"views": ()},
        {"views": (ChannelView("events", 1), ChannelView("events", 2))},
        {"views": (ChannelView("colour", 1),)},
        {"views": (ChannelView("events", -1, 1, 3),)},
        {"views": (ChannelView("events", 0),)},
        {"views": (ChannelView("events", 1, 0, 1),)},
        {"fc1": 0},
        {"every": 0},
    ],
)
def test_impossible_architectures_are_refused(change: dict[str, Any]) -> None:
    """Assert that a row that cannot be built is refused when it is written."""
    assert replace(HIST10) == HIST10
    with pytest.raises(ValueError, match="found"):
        replace(HIST10, **change)
