"""What `evaluate` refuses: the type of the error and its place, before anything is written."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost import command as cost
from evetac_cli.evaluate.data_rate import EvaluateDataRate
from evetac_cli.evaluate.data_rate import measure as data_rate
from evetac_cli.evaluate.grasp import EvaluateGrasp
from evetac_cli.evaluate.grasp import measure as grasp
from evetac_cli.evaluate.realism import EvaluateRealism
from evetac_cli.evaluate.realism import measure as realism
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as slip
from evetac_cli.evaluate.vibration import EvaluateVibration
from evetac_cli.evaluate.vibration import measure as vibration
from tests.make import event_arrays, events_at, run_stage, write_recording

SLICES = {"a": 300, "b": 1000, "short": 50, "empty": 0}
SMALL = (64, 48)
WINDOWS = ("", "x", "0.05", "11", "1,,2", "nan", "-1")


@pytest.mark.parametrize(
    ("stage", "names", "params", "place"),
    [
        (data_rate, "empty", EvaluateDataRate(), "empty"),
        *((vibration, "a", EvaluateVibration(windows=text), "--windows") for text in WINDOWS),
        (vibration, "a", EvaluateVibration(rate=100, lowest_hz=50.0), "--lowest-hz"),
        (vibration, "short", EvaluateVibration(), "short"),
        (realism, "a", EvaluateRealism(), ""),
        (realism, "a a", EvaluateRealism(), "a"),
        (realism, "a b", EvaluateRealism(), "b"),  # other frames
        (realism, "a short", EvaluateRealism(), "a"),  # no phase in common
        (grasp, "a", EvaluateGrasp(), "a"),
        (slip, "", EvaluateSlip(), "--model"),
        (cost, "a", EvaluateCost(part="track"), "evaluate cost track"),
        (cost, "a", EvaluateCost(part="grasp"), "evaluate cost grasp"),
        (cost, "", EvaluateCost(part="track", model=Path("a.model.h5")), "evaluate cost track"),
        (cost, "", EvaluateCost(part="track", trials=3), "--trials"),
        (cost, "", EvaluateCost(part="model", trials=3), "--trials"),
    ],
)
def test_refused(stage: Any, names: str, params: Any, place: str, tmp_path: Path) -> None:
    """Assert that flags and recordings that make no sense are an InputError at their place, and leave no report."""
    files = []
    for name in names.split():
        slices = SLICES[name]
        arrays = event_arrays(events_at(np.arange(slices) * 1000), slices, *([SMALL] if name != "b" else []))
        files.append(write_recording(tmp_path / f"{name}.recording.h5", arrays))
    with pytest.raises(InputError) as refused:
        run_stage(stage, files, params, tmp_path / "r.report.h5")
    at = place if place.startswith(("-", "evaluate")) or not place else str(tmp_path / f"{place}.recording.h5")
    assert refused.value.where.startswith(at)
    assert not list(tmp_path.glob("*.report.*"))


def test_every_part_is_a_choice() -> None:
    """Assert that the table of parts holds those that the command accepts, no more and no fewer."""
    (part,) = (item for item in fields(EvaluateCost) if item.name == "part")
    assert tuple(cost.PARTS) == part.metadata["choices"]
