"""The stability suite in a short form: every extreme stays finite and gains no energy, all nonsense is refused."""

import json
import math

import pytest

from evetac_cli.numerics.gel import stability as gel_stability
from evetac_cli.numerics.camera.stability import camera_cases, camera_row
from evetac_cli.numerics.gel.stability import (
    FingerCase,
    GelCase,
    drawn_case,
    finger_cases,
    finger_row,
    gel_cases,
    gel_row,
    nonsense,
    stability,
)
from evetac_cli.numerics.rows import SIMULATOR
from evetac_cli.sim import gripper
from evetac_cli.sim.gel import gel

CASES = {case.name: case for case in gel_cases()}
NONSENSE = dict(nonsense())
DRAWN = [drawn_case(seed=1, number=number) for number in range(12)]


def ok_and_finite(row):
    """A valid case may not hide behind a refusal."""
    return row["ok"] and row["outcome"].startswith("finite")


# -- what is asked for -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("theta", [0.5, 0.55, 1.0])
@pytest.mark.parametrize("name", CASES)
def test_extremes_of_the_gel(name, theta):
    """Assert that an extreme is finite, in balance within 1e-6, and gains no energy, at every theta."""
    row = gel_row(CASES[name], steps=25, theta=theta)
    assert ok_and_finite(row), row
    assert row["residual_most"] <= 1e-6
    assert 1 <= row["sweeps_mean"] <= row["sweeps_most"] < 400


@pytest.mark.parametrize("case", DRAWN, ids=lambda case: case.name)
def test_drawn_cases_of_the_gel(case):
    """Assert the same of cases that nobody chose."""
    row = gel_row(case, steps=40)
    assert ok_and_finite(row), row
    assert row["residual_most"] <= 1e-6


def test_the_search_ends_wherever_it_begins(monkeypatch):
    """Assert that a case with two loaded nodes, one about to slip, finds its balance also from the gel's own velocity.

    There, in its sixth step, that node slips so slowly that rounding hides in which direction.
    """

    def step(state, *given, **changes):
        state._mean_m_s[...] = state.velocity_m_s
        return real(state, *given, **changes)

    real = gel.step
    monkeypatch.setattr(gel_stability.gel, "step", step)
    row = gel_row(drawn_case(0, 106), theta=0.5)
    assert row["outcome"] == "finite"
    assert row["sweeps_most"] < 400


@pytest.mark.parametrize("case", finger_cases(), ids=lambda case: case.name)
def test_extremes_of_the_gripper(case):
    """Assert that a finger without damping or mass, or however stiff, closes without turning back."""
    assert ok_and_finite(finger_row(case))


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_is_refused(name):
    """Assert that NaN, infinite and negative values are refused with the reason."""
    row = SIMULATOR.refusal(name, NONSENSE[name])
    assert row["ok"]
    assert len(row["outcome"]) > len("refused: ") + 10


def test_the_suite_holds_all_that_it_should():
    """Assert that the extremes which the physics names are among the cases, and that nothing has two names."""
    names = [row["case"] for row in stability(steps=2)]
    assert len(names) == len(set(names))
    for wanted in (
        "mu 0", "mu 1000", "object of 1e-06 kg", "object of 1000 kg", "gel 0.01 times as stiff",
        "gel 1e+06 times as stiff", "impact at 100 m/s", "impact at 1e4 m/s", "spin of 1e4 rad/s",
        "grip lost and regained", "grip of 0 N", "grip of 1e+06 N", "time step 1e-07 s", "time step 0.1 s",
        "force of 498 Hz, time step 1 ms", "force of 498 Hz, time step 0.1 ms", "Maxwell time 1e-09 s",
        "Maxwell time 1e+09 s", "gel without mass and without losses", "grid of 1 x 1 nodes", "grid of 64 x 48 nodes",
        "time step nan s", "object of inf kg", "grip of -1 N", "camera: nothing moves, no noise",
        "camera: noise of 1e4 Hz a pixel", "camera: all dots jump by 50 px and back", "camera, a dot at nan px",
    ):  # fmt: skip
        assert wanted in names


def test_rows_have_one_shape():
    """Assert that rows of gel, gripper, camera and nonsense have the same flat columns, and JSON can hold them."""
    rows = [
        gel_row(CASES["mu 0"], 2),
        finger_row(finger_cases()[0], 2),
        camera_row(camera_cases()[0], 1),
        SIMULATOR.refusal("x", lambda: gel.Friction(-1, -1)),
    ]
    names = ["case", "ok", "outcome", "sweeps_mean", "sweeps_most", "residual_most", "energy_gained_j"]
    assert [list(row) for row in rows] == [names] * 4
    json.dumps(rows, allow_nan=False)


def test_seeds_draw_other_cases():
    """Assert that a case is drawn by seed and number alone."""
    one, same, other, next_seed = (drawn_case(*by) for by in ((0, 3), (0, 3), (0, 4), (1, 3)))
    assert one.material == same.material
    assert one.dt_s == same.dt_s
    assert len({one.mass_kg, other.mass_kg, next_seed.mass_kg}) == 3


# -- that a fault would be seen ----------------------------------------------------------------------------------------


def test_gained_energy_is_seen(monkeypatch):
    """Assert that energy from nowhere is not ok: here every step makes the object faster by itself."""

    def step(state, *given, **changes):
        info = real(state, *given, **changes)
        state.twist *= 1.01
        return info

    real = gel.step
    monkeypatch.setattr(gel_stability.gel, "step", step)
    row = gel_row(CASES["impact at 100 m/s"], 10)
    assert not row["ok"]
    assert row["outcome"] == "finite, energy gained"
    assert row["energy_gained_j"] > 0


def test_what_is_not_finite_is_seen(monkeypatch):
    """Assert that a pose which became NaN without a refusal is not ok."""

    def step(state, *given, **changes):
        info = real(state, *given, **changes)
        if state.pose[0] > 1e-5:
            state.pose[1] = math.nan
        return info

    real = gel.step
    monkeypatch.setattr(gel_stability.gel, "step", step)
    row = gel_row(GelCase("falls", load=lambda _: 0.0), 2)
    assert not row["ok"]
    assert row["outcome"].startswith("not finite")


def test_steps_without_balance_are_told(monkeypatch):
    """Assert that the outcome counts the steps whose residual is too large."""
    real = gel.step
    monkeypatch.setattr(gel_stability.gel, "step", lambda *given, **how: real(*given, **how)._replace(residual=1e-3))
    row = gel_row(GelCase("one node", columns=1, rows=1), 3)
    assert row["outcome"] == "finite, 3 of 3 steps without balance"
    assert row["residual_most"] == 1e-3


def test_a_wrong_case_is_refused():
    """Assert that a case which the gel refuses is ok, and says why."""
    row = gel_row(GelCase("heavy", mass_kg=math.nan), 2)
    assert row["outcome"].startswith("refused: body_mass_kg must be finite")
    assert row["ok"]


def test_a_finger_that_turns_back_is_seen(monkeypatch):
    """Assert that a finger which chatters is not ok."""
    speeds = iter([1e-3, -1e-3] * 5)

    def step(state, *_):
        state.speed_m_s = next(speeds)

    monkeypatch.setattr(gel_stability.gripper, "step", step)
    row = finger_row(FingerCase("chatters", gripper.Drive()), 10)
    assert not row["ok"]
    assert "turned back 9 times" in row["outcome"]
