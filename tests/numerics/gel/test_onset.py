"""The onset of slip in cases of the gel: by hand, against its reference, and faults would be seen."""

import math

import pytest

from evetac_cli.numerics.bounds import ONSET
from evetac_cli.numerics.gel import onset
from evetac_cli.numerics.gel.case import GelCase
from evetac_cli.numerics.gel.onset import SLID_M, onset_cases, onset_error, onset_s
from evetac_cli.numerics.gel.stability import gel_rows
from evetac_cli.sim.gel import gel

CASES = {case.name: (case, within_s) for case, within_s in onset_cases()}
CONSTANT = "grip falls at 9 N/s, friction constant"
INFO = gel.StepInfo(1, 0.0, True, 1.0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture
def slips(monkeypatch):
    """Let every step have this share of slipping nodes and this slip speed, over the number of the step."""

    def install(motion):
        numbers = iter(range(10_000))

        def step(*given, **changes):
            share, speed_m_s = motion(next(numbers))
            return INFO._replace(slip_fraction=share, slip_velocity_m_s=(speed_m_s, 0.0))

        monkeypatch.setattr(gel, "step", step)

    return install


def test_onset_by_hand(slips):
    """Assert the moment within the step at which half a pixel has been slid, and that incipient slip does not count."""
    slips(lambda number: (0.9, 1.0) if number < 5 else (1.0, 0.4 * SLID_M / 1e-3))
    assert onset_s(GelCase("x"), 0.02, 1e-3, 0.55) == pytest.approx(7.5e-3)


def test_a_stuck_node_ends_the_episode(slips):
    """Assert that slid distance counts through 3 ms of a stuck node, and begins anew after more."""
    for stuck, more in ((3, 0.5), (4, 2.5)):  # slices, after 2 in which 0.8 of the distance was slid
        slips(lambda number, stuck=stuck: (0.9 if 2 <= number < 2 + stuck else 1.0, 0.4 * SLID_M / 1e-3))
        assert onset_s(GelCase("x"), 0.02, 1e-3, 0.55) == pytest.approx((2 + stuck + more) * 1e-3)


def test_an_object_that_never_slides(slips):
    """Assert that there is no onset without grip or without slip, and that no onset is within no bound."""
    slips(lambda number: (1.0, 1.0))
    assert math.isnan(onset_s(GelCase("x", load=lambda _: 0.0), 0.02, 1e-3, 0.55))
    slips(lambda number: (0.5, 1.0))
    (bound, error_ms), words = onset_error(GelCase("x"), 0.02, 0.55)
    assert bound is ONSET
    assert not error_ms <= ONSET.most
    assert words.startswith("slides never, reference never")


def test_friction_changes_at_a_time(monkeypatch):
    """Assert that a case's friction is another from its time on."""
    seen = []

    def step(state, nodal, force, friction, dt_s, theta):
        seen.append(friction.static)
        return INFO._replace(slip_fraction=0.0)

    monkeypatch.setattr(gel, "step", step)
    onset_s(GelCase("x", becomes=(5e-3, gel.Friction(0.08, 0.08))), 0.01, 1e-3, 0.5)
    assert seen == [0.8] * 5 + [0.08] * 5


def test_onset_with_constant_friction():
    """Assert that with constant friction, steps of 1 ms have the onset of the reference within the bound."""
    case, within_s = CASES[CONSTANT]
    (_, error_ms), words = onset_error(case, within_s, 0.55)
    assert error_ms <= ONSET.most, words


def test_a_late_onset_is_seen(monkeypatch):
    """Assert that a gel that lets go too late at steps of 1 ms is not ok, and that the row says when it should."""

    def step(state, nodal, force, friction, dt_s, theta):
        return real(state, 1.05 * nodal if dt_s == 1e-3 else nodal, force, friction, dt_s, theta=theta)

    real = gel.step
    monkeypatch.setattr(gel, "step", step)
    monkeypatch.setattr(onset, "REFERENCE_S", (2.5e-4, 5e-4))
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
