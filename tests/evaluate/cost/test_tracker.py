"""Error against run time of the dot tracker in a short form."""

import json
from unittest import mock

import pytest

from evetac_cli.evaluate.common.rows import Extent
from evetac_cli.evaluate.cost import EvaluateCost, command
from evetac_cli.evaluate.cost import tracker as cost
from evetac_cli.jobs import silent
from evetac_cli.kernels.tracking.presets import PRESETS

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rows() -> list[dict[str, object]]:
    """All rows of the cost, from short workloads."""
    with mock.patch.multiple(cost, SLICES=Extent((60, 25, 60), None), STEPS=Extent(25, None)):
        return cost.measure(EvaluateCost(part="track"), (), silent)


def test_cost_has_a_row_for_every_setting_and_workload(rows):
    """Assert that rows are of one shape, and finite."""
    assert len(rows) == 6 * (1 + len(list(cost.settings())))
    assert len({tuple(row) for row in rows}) == 1
    assert len({(row["part"], row["setting"]) for row in rows}) == len(rows)
    json.dumps(rows, allow_nan=False)
    assert {name for name in rows[0] if name.startswith("error_")} == set(command.PARTS["track"].errors)
    assert [name for name in rows[0] if name.startswith("time_us_")][2:] == [
        f"time_us_{count}" for count in (0, 50, 200, 1000, 5000, 20000)
    ]
    for preset in PRESETS:
        assert sum(row["setting"] == f"{preset}, all events" for row in rows) == 6


def test_stable_beats_standing_still_and_the_paper(rows):
    """Assert that on every workload, short as it is, `stable` is better than standing still and than `paper`."""
    for part in {row["part"] for row in rows}:
        error = {row["setting"]: row["error_px_rms"] for row in rows if row["part"] == part}
        still = next(row["still_px_rms"] for row in rows if row["part"] == part)
        assert error["standing still"] == still
        assert error["stable, all events"] < min(still, error["paper, all events"])
