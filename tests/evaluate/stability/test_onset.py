"""The onset of slip in cases of the gel: by hand, against its reference, and faults would be seen."""

import math

import pytest

from evetac_cli.evaluate.stability import onset
from evetac_cli.evaluate.stability.bounds import ONSET, RESOLVED
from evetac_cli.evaluate.stability.gel import gel_rows
from evetac_cli.evaluate.stability.gel_case import GelCase
from evetac_cli.evaluate.stability.onset import WEIGHT_ON_S, onset_cases, onset_error, onset_s
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.setup.solver import Solver

CASES = {case.name: (case, within_s) for case, within_s in onset_cases()}
CONSTANT = "grip falls at 9 N/s, friction constant"
FREE = gel.Friction(0.0, 0.0)


def test_onset_by_hand():
    """Assert that an object without friction slides by half a pixel as it falls, interpolated within the slice."""
    fallen_um = [0.5 * 9.81 * time_s**2 * 1e6 for time_s in (1e-3, 2e-3)]
    wanted_ms = 1.0 + (0.5 * 32.9 - fallen_um[0]) / (fallen_um[1] - fallen_um[0])
    found_s = onset_s(GelCase("x", columns=6, rows=5, friction=FREE), 0.01, Solver(step_ms=0.05))
    assert 1e3 * found_s == pytest.approx(wanted_ms, abs=0.02)


def test_friction_changes_at_a_time():
    """Assert that an object sticks until its friction is gone."""
    case = GelCase("x", columns=6, rows=5, becomes=(20e-3, FREE))
    assert 20e-3 < onset_s(case, 0.03, Solver()) < 22e-3


@pytest.mark.parametrize("name", ["slides, gel a tenth as stiff", "slides, object of 2 kg"])
def test_incipient_slip_on_a_coarse_grid_is_no_onset(name):
    """Assert that an object whose contact slips in patches while its weight is handed over does not slip yet.

    Nodes are too far apart for its unstable slip, and each lets go now and then; the grip holds it until well after.
    """
    case, within_s = CASES[name]
    assert onset_s(case, within_s, Solver()) > 3 * WEIGHT_ON_S


def test_an_object_that_never_slips():
    """Assert that there is no onset of what sticks, and that no onset is within no bound."""
    case = GelCase("x", columns=6, rows=5, friction=gel.Friction(10.0, 10.0))
    ((bound, error_ms),), words = onset_error(case, 0.005, 0.55)
    assert bound is ONSET
    assert math.isnan(error_ms)
    assert words.startswith("slips never, reference never")


def test_onset_with_constant_friction():
    """Assert that with constant friction the default steps have the onset of the reference within the bound."""
    case, within_s = CASES[CONSTANT]
    ((_, error_ms),), words = onset_error(case, within_s, 0.55)
    assert error_ms <= ONSET.most, words


def test_a_late_onset_is_seen(monkeypatch):
    """Assert that a gel which lets go too late with the default steps is not ok, and that its row says when."""

    def advance(self, state, shares, *given, **how):
        return real(self, state, 1.05 * shares if self.solver.step_ms is None else shares, *given, **how)

    real = Stepper.advance
    monkeypatch.setattr(Stepper, "advance", advance)
    monkeypatch.setattr(onset, "REFERENCE_MS", (0.25, 0.5))
    case, within_s = CASES[CONSTANT]
    row = gel_rows(case, slides_within_s=within_s)[-1]
    assert (row["quantity"], row["ok"]) == (ONSET.quantity, False)
    assert row["value"] > 1.0
    assert "reference at" in row["outcome"]


def test_every_onset_case_is_another():
    """Assert that names are unique, and that the extremes of scenes are there."""
    assert len(CASES) == len(onset_cases())
    assert {case.mass_kg for case, _ in CASES.values()} == {0.1, 0.005, 2.0}
    assert len({case.friction for case, _ in CASES.values()}) == 4
    case, _ = CASES["slides, hand jerks by 20 m/s2 for 30 ms"]
    assert case.force(0.135)[0] == pytest.approx(0.981 + 2.0)
    assert case.force(0.2)[0] == pytest.approx(0.981)


def test_a_grid_that_does_not_resolve_its_slip_is_not_ok(monkeypatch):
    """Assert that a case whose unstable slip is shorter than the nodes resolve misses a bound, and its row says so."""
    monkeypatch.setattr(onset, "onset_s", lambda *given: 0.2)
    for pressed, ok in ((0.1, True), (100.0, False)):
        case = GelCase("x", columns=6, rows=5, friction=gel.Friction(0.8, 0.4), load=lambda _, n=pressed: n)
        measured, words = onset_error(case, 0.1, 0.55)
        values = {bound.quantity: value for bound, value in measured}
        assert values[ONSET.quantity] == 0.0
        assert (values.get(RESOLVED.quantity, 0.0) <= RESOLVED.most) == ok
        assert ("it depends on the grid" in words) != ok
