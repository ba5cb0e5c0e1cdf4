"""Settings that a user can choose: what they are called, and the flags that choose them."""

from dataclasses import fields

from evetac_cli.numerics.settings import Setting, line
from evetac_cli.params.grasp import Grasp
from evetac_cli.params.parameter import flag_of
from evetac_cli.params.recording import Record


def test_names_and_flags() -> None:
    """Assert that a setting is named by its line and value, and says the flags that choose it."""
    quarter, tenth = line("fixed step", "step_ms", (0.25, 0.1), "ms")
    assert (quarter.name, quarter.flags) == ("fixed step, 0.25 ms", "--step-ms 0.25")
    assert (tenth.name, tenth.flags) == ("fixed step, 0.1 ms", "--step-ms 0.1")
    (both,) = line("node pitch", "node_pitch_mm", (0.625,), "mm", step_ms=0.25)
    assert (both.name, both.flags) == ("node pitch, 0.625 mm", "--node-pitch-mm 0.625 --step-ms 0.25")
    assert Setting("tolerance", solver={"tolerance_um": 0.05}).flags == "--tolerance 0.05"
    assert Setting("defaults").flags == ""


def test_flags_are_those_of_both_commands() -> None:
    """Assert that record and grasp have the flags under the same names."""
    for command in (Record, Grasp):
        flags = {flag_of(item) for item in fields(command)}
        assert {"--step-ms", "--tolerance", "--theta", "--node-pitch-mm", "--camera-substeps"} <= flags
