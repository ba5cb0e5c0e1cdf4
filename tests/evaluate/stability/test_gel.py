"""The extreme cases of the gel in a short form: each keeps its balance and gains no energy; faults would be seen."""

import math

import pytest

from evetac_cli.evaluate.common.gel_case import GelCase
from evetac_cli.evaluate.stability import gel as gel_stability
from evetac_cli.evaluate.stability.cases import BALANCE, ENERGY, ONSET, RESOLVED
from evetac_cli.evaluate.stability.gel import (
    WEIGHT_ON_S,
    gel_cases,
    gel_rows,
    onset_cases,
    onset_error,
    onset_s,
    random_case,
)
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.setup.scene import Solver

CASES = {case.name: case for case in gel_cases()}
ONSETS = {case.name: case for case in onset_cases()}
CONSTANT = "grip falls at 9 N/s, friction constant"
FREE = gel.Friction(0.0, 0.0)
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
        state.mean_m_s[...] = state.velocity_m_s
        return real(state, *given, **changes)

    real = gel.step
    monkeypatch.setattr(gel_stability.gel, "step", step)
    assert_within_bounds(gel_rows(random_case(0, 106), theta=0.5))


# -- that a fault would be seen ----------------------------------------------------------------------------------------


def test_what_is_not_finite_is_seen(monkeypatch):
    """Assert that a pose which became NaN without a refusal is within no bound."""

    def step(state, *given, **changes):
        info = real(state, *given, **changes)
        if state.pose[0] > 1e-5:
            state.pose[1] = math.nan
        return info

    real = gel.step
    monkeypatch.setattr(gel_stability.gel, "step", step)
    rows = gel_rows(GelCase("falls", load=lambda _: 0.0), 2)
    assert not_ok(rows) == [ENERGY.quantity, BALANCE.quantity]
    assert rows[0]["outcome"].startswith("not finite")


# -- the onset ---------------------------------------------------------------------------------------------------------


def test_onset_by_hand():
    """Assert that an object without friction slides by half a pixel as it falls, interpolated within the slice."""
    fallen_um = [0.5 * 9.81 * time_s**2 * 1e6 for time_s in (1e-3, 2e-3)]
    wanted_ms = 1.0 + (0.5 * 32.9 - fallen_um[0]) / (fallen_um[1] - fallen_um[0])
    found_s = onset_s(GelCase(columns=6, rows=5, friction=FREE, seconds=0.01), Solver(step_ms=0.05))
    assert 1e3 * found_s == pytest.approx(wanted_ms, abs=0.02)


def test_friction_changes_at_a_time():
    """Assert that an object sticks until its friction is gone."""
    case = GelCase(columns=6, rows=5, becomes=(20e-3, FREE), seconds=0.03)
    assert 20e-3 < onset_s(case, Solver()) < 22e-3


@pytest.mark.parametrize("name", ["slides, gel a tenth as stiff", "slides, object of 2 kg"])
def test_incipient_slip_on_a_coarse_grid_is_no_onset(name):
    """Assert that an object whose contact slips in patches while its weight is handed over does not slip yet.

    Nodes are too far apart for its unstable slip, and each lets go now and then; the grip holds it until well after.
    """
    assert onset_s(ONSETS[name], Solver()) > 3 * WEIGHT_ON_S


def test_an_object_that_never_slips():
    """Assert that there is no onset of what sticks, and that no onset is within no bound."""
    case = GelCase(columns=6, rows=5, friction=gel.Friction(10.0, 10.0), seconds=0.005)
    ((bound, error_ms),), words = onset_error(case, 0.55)
    assert bound is ONSET
    assert math.isnan(error_ms)
    assert words.startswith("slips never, reference never")


def test_onset_with_constant_friction():
    """Assert that with constant friction the default steps have the onset of the reference within the bound."""
    ((_, error_ms),), words = onset_error(ONSETS[CONSTANT], 0.55)
    assert error_ms <= ONSET.most, words


def test_a_late_onset_is_seen(monkeypatch):
    """Assert that a gel which lets go too late with the default steps is not ok, and that its row says when."""

    def advance(self, state, shares, *given, **how):
        return real(self, state, 1.05 * shares if self.solver.step_ms is None else shares, *given, **how)

    real = Stepper.advance
    monkeypatch.setattr(Stepper, "advance", advance)
    monkeypatch.setattr(gel_stability, "REFERENCE_MS", (0.25, 0.5))
    row = gel_rows(ONSETS[CONSTANT])[-1]
    assert (row["quantity"], row["ok"]) == (ONSET.quantity, False)
    assert row["value"] > 1.0
    assert "reference at" in row["outcome"]


def test_a_grid_that_does_not_resolve_its_slip_is_not_ok(monkeypatch):
    """Assert that a case whose unstable slip is shorter than the nodes resolve misses a bound, and its row says so."""
    monkeypatch.setattr(gel_stability, "onset_s", lambda *given: 0.2)
    for pressed, ok in ((0.1, True), (100.0, False)):
        case = GelCase(columns=6, rows=5, friction=gel.Friction(0.8, 0.4), load=lambda _, n=pressed: n)
        measured, words = onset_error(case, 0.55)
        values = {bound.quantity: value for bound, value in measured}
        assert values[ONSET.quantity] == 0.0
        assert (values.get(RESOLVED.quantity, 0.0) <= RESOLVED.most) == ok
        assert ("it depends on the grid" in words) != ok
