"""Settings that a user can choose: names, flags, and the plans that they lead to."""

from evetac_cli.numerics.settings import Setting, line
from evetac_cli.sim import scene


def test_names_and_flags() -> None:
    """Assert that a setting is named by its line and value, and says the flags that choose it."""
    quarter, tenth = line("fixed step", "step_ms", (0.25, 0.1), "ms")
    assert (quarter.name, quarter.flags) == ("fixed step, 0.25 ms", "--step-ms 0.25")
    assert (tenth.name, tenth.flags) == ("fixed step, 0.1 ms", "--step-ms 0.1")
    both = Setting("reference", solver={"step_ms": 0.1, "node_pitch_mm": 0.625})
    assert (both.name, both.flags) == ("reference", "--step-ms 0.1 --node-pitch-mm 0.625")
    assert Setting("defaults").flags == ""


def test_plans() -> None:
    """Assert that a setting goes into the scene's table [solver] and leaves the plan it was given as it was."""
    (plan,) = scene.plan("slip", "8", "evetac", ("ramp",))
    before = dict(plan["scene"])
    chosen = Setting("tolerance", solver={"tolerance": 0.01}).plan(plan)
    assert chosen["scene"]["solver"]["tolerance"] == 0.01
    assert plan["scene"] == before
    assert Setting("defaults").plan(plan) == plan
