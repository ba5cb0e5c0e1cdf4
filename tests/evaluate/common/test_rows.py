"""What the rows of `evaluate cost` have in common: extents, progress, run times, settings and their flags."""

import pytest

from evetac_cli.evaluate.common.rows import SolverSetting, ends, line, resampled


def test_names_and_flags() -> None:
    """Assert that a setting is named by its line and value, and says the flags that choose it."""
    quarter, tenth = line("fixed step", "step_ms", (0.25, 0.1), "ms")
    assert (quarter.name, quarter.flags) == ("fixed step, 0.25 ms", "--step-ms 0.25")
    assert (tenth.name, tenth.flags) == ("fixed step, 0.1 ms", "--step-ms 0.1")
    (both,) = line("node pitch", "node_pitch_mm", (0.625,), "mm", step_ms=0.25)
    assert (both.name, both.flags) == ("node pitch, 0.625 mm", "--node-pitch-mm 0.625 --step-ms 0.25")
    assert SolverSetting("tolerance", solver={"tolerance_um": 0.05}).flags == "--tolerance 0.05"
    assert SolverSetting("defaults").flags == ""


def test_the_interval_of_a_mean_spans_its_values() -> None:
    """Assert the ends for two values, of which either may be drawn twice, and none for fewer that are known."""
    assert ends("f1", resampled([0.6, None, 0.9])) == pytest.approx({"f1_low": 0.6, "f1_high": 0.9})
    assert ends("f1", resampled([0.5, None])) == {"f1_low": None, "f1_high": None}
