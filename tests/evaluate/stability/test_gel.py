"""The extreme cases of the gel in a short form: each keeps its balance and gains no energy; faults would be seen."""

import math

import pytest

from evetac_cli.evaluate.stability import gel_case
from evetac_cli.evaluate.stability.bounds import BALANCE, ENERGY
from evetac_cli.evaluate.stability.gel import gel_cases, gel_rows, random_case
from evetac_cli.evaluate.stability.gel_case import GelCase
from evetac_cli.sim.gel import gel

CASES = {case.name: case for case in gel_cases()}
RANDOM = [random_case(seed=1, number=number) for number in range(12)]


def assert_within_bounds(rows):
    """A valid case may not hide behind a refusal."""
    assert all(row["ok"] for row in rows), rows
    assert [row["quantity"] for row in rows] == [ENERGY.quantity, BALANCE.quantity]
    assert int(rows[0]["outcome"].rpartition(" ")[2]) < 400  # sweeps: the search never gave up


def not_ok(rows):
    return [row["quantity"] for row in rows if not row["ok"]]


# -- the cases ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("theta", [0.5, 0.51, 1.0])
@pytest.mark.parametrize("name", CASES)
def test_extremes_of_the_gel(name, theta):
    """Assert that an extreme is finite, in balance within 1e-6, and gains no energy, at every theta."""
    assert_within_bounds(gel_rows(CASES[name], steps=25, theta=theta))


@pytest.mark.parametrize("case", RANDOM, ids=lambda case: case.name)
def test_random_cases_of_the_gel(case):
    """Assert the same of cases that are drawn."""
    assert_within_bounds(gel_rows(case, steps=40))


def test_the_search_ends_wherever_it_begins(monkeypatch):
    """Assert that a case with two loaded nodes, one about to slip, finds its balance also from the gel's own velocity.

    There, in its sixth step, that node slips so slowly that rounding hides in which direction.
    """

    def step(state, *given, **changes):
        state._mean_m_s[...] = state.velocity_m_s
        return real(state, *given, **changes)

    real = gel.step
    monkeypatch.setattr(gel_case.gel, "step", step)
    assert_within_bounds(gel_rows(random_case(0, 106), theta=0.5))


def test_seeds_draw_other_cases():
    """Assert that a case is drawn by seed and number alone."""
    one, same, other, next_seed = (random_case(*by) for by in ((0, 3), (0, 3), (0, 4), (1, 3)))
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
    monkeypatch.setattr(gel_case.gel, "step", step)
    rows = gel_rows(CASES["impact at 100 m/s"], 10)
    assert not_ok(rows) == [ENERGY.quantity]
    assert rows[0]["value"] > 0.01


def test_what_is_not_finite_is_seen(monkeypatch):
    """Assert that a pose which became NaN without a refusal is within no bound."""

    def step(state, *given, **changes):
        info = real(state, *given, **changes)
        if state.pose[0] > 1e-5:
            state.pose[1] = math.nan
        return info

    real = gel.step
    monkeypatch.setattr(gel_case.gel, "step", step)
    rows = gel_rows(GelCase("falls", load=lambda _: 0.0), 2)
    assert not_ok(rows) == [ENERGY.quantity, BALANCE.quantity]
    assert rows[0]["outcome"].startswith("not finite")


def test_steps_without_balance_are_told(monkeypatch):
    """Assert that the outcome counts the steps whose residual is too large."""
    real = gel.step

    def replaced(*given, **how):
        return real(*given, **how)._replace(residual=1e-3)

    monkeypatch.setattr(gel_case.gel, "step", replaced)
    rows = gel_rows(GelCase("one node", columns=1, rows=1), 3)
    assert not_ok(rows) == [BALANCE.quantity]
    assert rows[1]["outcome"].startswith("3 of 3 steps without balance")
    assert rows[1]["value"] == 1e-3


def test_a_wrong_case_is_refused():
    """Assert that a case which the gel refuses is ok, and says why."""
    (row,) = gel_rows(GelCase("heavy", mass_kg=math.nan), 2)
    assert row["outcome"].startswith("refused: body_mass_kg: expected above 0")
    assert row["ok"]
