"""The drive of a gripper from its rows, against drives that are known."""

from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.sim import gripper
from evetac_cli.sim.gel.contact import ForceCurve
from evetac_cli.sim.setup import scene_file
from evetac_cli.stages.identify import drive
from evetac_cli.stages.identify.drive import GripperRows

SECONDS = 13.0
FORCE_PER_CURRENT = 0.4


def simulated(
    friction_n: float,
    damping: float,
    mass_kg: float,
    backlash_ticks: float,
    noise_ticks: float = 0.0,
    *,
    share: float = 1.0,
):
    """Rows of the scene grip-steps by a drive whose force rises evenly with its closing, 1.4 ticks a mA."""
    course = scene_file.load("grip-steps").gripper.current
    assert course is not None
    current_ma = np.array([float(round(course.at(ms * 1e-3))) for ms in range(round(1000 * SECONDS))])
    ticks = np.arange(0.0, 200.0, 0.05)
    curve = ForceCurve(0.05, gripper.metres_per_tick(0.06), ticks / 1.4 * FORCE_PER_CURRENT, np.zeros(len(ticks)))
    known = gripper.Drive(
        force_per_current_n_ma=FORCE_PER_CURRENT,
        friction_n=friction_n,
        damping_n_s_m=damping,
        mass_kg=mass_kg,
        backlash_ticks=backlash_ticks,
        kinetic_share=share,
    )
    motor, _ = gripper.places(known, curve, 361.0, -300.0, current_ma, 1e-3)
    rows = np.arange(1, len(motor), 2)
    noise = noise_ticks * np.random.default_rng(0).normal(size=len(rows))
    place = np.floor(motor[rows] + noise).astype(np.int64)
    return GripperRows((rows + 1) * 1000, current_ma[rows], current_ma[rows], place)


@pytest.mark.parametrize(
    ("friction_n", "damping", "mass_kg", "backlash_ticks", "noise_ticks"),
    [(3.9, 150.0, 2.0, 0.0, 0.0), (7.0, 240.0, 4.5, 2.5, 0.3), (2.5, 110.0, 0.8, 1.0, 0.6)],
)
def test_a_known_drive(
    friction_n: float, damping: float, mass_kg: float, backlash_ticks: float, noise_ticks: float
) -> None:
    """Assert friction and damping in current within 2 %, bending within 6 %, lost motion within 0.3 ticks."""
    fit = drive.fit(simulated(friction_n, damping, mass_kg, backlash_ticks, noise_ticks))
    assert fit.values["friction_ma"] == pytest.approx(friction_n / FORCE_PER_CURRENT, rel=0.02)
    assert fit.values["damping_ma_s_m"] == pytest.approx(damping / FORCE_PER_CURRENT, rel=0.02)
    assert fit.values["mass_ma_s2_m"] == pytest.approx(mass_kg / FORCE_PER_CURRENT, rel=0.25)
    assert fit.values["finger_ticks_ma"] == pytest.approx(1.4, rel=0.06)
    assert fit.values["backlash_ticks"] == pytest.approx(backlash_ticks, abs=0.3)
    assert fit.residual_ticks < 0.8 and sum(map(len, fit.rests)) > 500


@pytest.mark.parametrize("share", [0.9, 0.67])
def test_a_gear_that_breaks_loose(share: float) -> None:
    """Assert that the friction which is told of it is about that in motion, and damping and bending are as they are."""
    fit = drive.fit(simulated(3.9, 150.0, 2.0, 0.0, share=share))
    assert fit.values["friction_ma"] == pytest.approx(share * 3.9 / FORCE_PER_CURRENT, rel=0.12)
    assert fit.values["damping_ma_s_m"] == pytest.approx(150.0 / FORCE_PER_CURRENT, rel=0.06)
    assert fit.values["finger_ticks_ma"] == pytest.approx(1.4, rel=0.06)
    assert all(np.isfinite(fit.sd[name]) for name in fit.values)


def test_rows_count_by_what_is_commanded() -> None:
    """Assert that a measured current which is never the same twice changes nothing in which rows are fitted."""
    rows = simulated(3.9, 150.0, 2.0, 1.0)
    noise_ma = np.random.default_rng(0).normal(0.0, 0.5, len(rows.measured_ma))
    noisy = replace(rows, measured_ma=rows.measured_ma + noise_ma)
    np.testing.assert_array_equal(drive._blocks(noisy), drive._blocks(rows))
    assert 0.1 < np.mean(drive._blocks(rows) < 0) < 0.9


def still(place: np.ndarray, current_ma: np.ndarray) -> GripperRows:
    return GripperRows(np.arange(1, len(place) + 1) * 2000, current_ma, current_ma, place.astype(np.int64))


def test_what_is_no_grip() -> None:
    """Assert that a gripper which never closes, never opens again, closes by no current, or has few rows is refused."""
    rising = np.linspace(0, 60, 3000)
    with pytest.raises(ValueError, match="never closes"):
        drive.fit(still(np.full(3000, 61), rising))
    with pytest.raises(ValueError, match="never opens"):
        drive.fit(still(61 + 5 * rising, rising))
    with pytest.raises(ValueError, match="does not close"):
        drive.fit(still(61 + 5 * rising, np.zeros(3000)))
    with pytest.raises(ValueError, match="fewer than 1000 rows"):
        drive.fit(still(np.arange(500), np.arange(500.0)))
