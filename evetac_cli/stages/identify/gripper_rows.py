"""Rows of the table and keys of the sensor's file from recordings of a gripped object.

The width of an interval follows from the residuals of the fit, and is at least the error found on simulated sensors
(randomized:100 to 149). Forces need a scale. For the gel's shear this is the object's weight. For the normal force, it
can only be a measured force per current. Without it, all dependent parameters are estimated in terms of current, and
the file uses the force per current of the sensor given by `--like`. The simulated gripper then closes, slips and
releases at the same currents.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from evetac_cli.arrays import Floats
from evetac_cli.commands.identify import Identify
from evetac_cli.kernels.estimates import LEVEL, Estimate
from evetac_cli.sim import gripper
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.stages.identify.drive import DriveFit
from evetac_cli.stages.identify.gripped import Gripped, Weight
from evetac_cli.stages.identify.sensor_text import Entry, EstimateRow

MAKE_GRIP = "cannot be estimated from these recordings: make one like the scene grip-steps (docs/identify.md)"
MAKE_GRASP = "cannot be estimated from these recordings: make one with evetac grasp --controller fixed:6"
MAKE_SLIP = "cannot be estimated from these recordings: make one in which the current falls until the object slips"
NO_MASS = "cannot be estimated without --object-mass-g, the mass of the object that was held"
NO_SCALE = "cannot be estimated without a known normal force: measure it between the fingers for --force-per-current"
NO_CREEP = (
    "cannot be estimated from these recordings: make one in which the weight is applied at once and hangs for 10 s"
)
BENDS = "cannot be estimated with a gripper: its fingers bend ten times as much as the gel"
QUIET = "cannot be estimated from a quiet hold: nothing moves the gel at 100 Hz"
# Smallest half widths of intervals, as a share of the value (drive, gel) or in the row's unit.
LEAST_SHARE = {"friction_ma": 0.006, "damping_ma_s_m": 0.012, "mass_ma_s2_m": 0.2, "finger_ticks_ma": 0.08}
BACKLASH_TICKS, BACKLASH_LOW_TICKS = 0.3, 0.05  # half width, and the bias of the fit, which is too low
ENCODER_LOW_TICKS, ENCODER_HIGH_TICKS = 0.06, 0.02  # a wrongly detected rest adds noise
MODULUS_SHARE, MODULUS_HIGH_SHARE = 0.10, 0.03  # half width, and the bias of the fit, which is too high
SCALE_SHARE, SCALE_POWER = 0.12, 1.5  # error of a pixel size that was not measured, and its power in the modulus.
# Half widths of both arms' share, common to all grips and for each grip, and the bias of the fit, which is too low.
CREEP_SHARE, CREEP_GRIP_SHARE, CREEP_LOW_SHARE = 0.015, 0.019, 0.009
# Friction varies over a gel, so each grip at another spot has an error (sd of the logarithm), and all grips share one.
# If the fingers are not parallel, one end of the contact slips and weakens before the other. The whole contact then
# holds less than its static friction: in logarithm, by SLIP_PART (sd SLIP_PART_SD) times the difference between the
# last and the first time of slip.
GRIP_SD, ALL_GRIPS_SD = 0.04, 0.05
SLIP_PART, SLIP_PART_SD = 0.5, 0.3
DELAY_MS, JITTER_MS = 3.5, 2.0  # widest intervals that are still informative
TWO_TICKS_N = 0.13


def rows(grips: Sequence[Gripped], priors: Identify, like: Sensor) -> tuple[list[EstimateRow], dict[str, Entry]]:
    """Return rows and keys of gripper, gel and friction from recordings and the prior knowledge given by flags.

    like: the sensor with the values of all other keys.
    """
    usual = gripper.make_drive(like.gripper)
    scale_n_ma = priors.force_per_current or usual.force_per_current_n_ma
    misfits = {part: why for one in reversed(grips) for part, why in one.misfits.items()}
    no_drive = misfits.get("drive", MAKE_GRIP)
    drive, drive_from = _told(grips, "drive", no_drive)
    gain, gain_from = _told(grips, "gain_ma_tick", misfits.get("gain", MAKE_GRASP))
    keys = {} if drive is None else _drive_keys(drive, gain, usual, scale_n_ma, drive_from)
    listed = _drive_rows(drive, drive_from)
    for part, key, unit, widest, why in (
        ("encoder_ticks", "encoder_noise_ticks", "ticks", math.inf, no_drive),
        ("delay_ms", "command_delay_ms", "ms", DELAY_MS, MAKE_GRIP),
        ("jitter_ms", "command_jitter_ms", "ms", JITTER_MS, MAKE_GRIP),
    ):
        estimate, source = _told(grips, part, why)
        if part == "encoder_ticks" and estimate is not None:
            low, high = estimate.low - ENCODER_LOW_TICKS, estimate.high + ENCODER_HIGH_TICKS
            estimate = Estimate(estimate.value, max(low, 0.0), high)
        if estimate is not None and estimate.high - estimate.low > widest:
            estimate, source = None, why
        if estimate is not None:
            keys[key] = Entry(estimate.value, estimate, source)
        listed.append(EstimateRow(f"gripper.{key}", unit, estimate, source))
    listed.append(EstimateRow("gripper: servo gain", "mA/tick", gain, gain_from))
    force_per_current = priors.force_per_current
    scale = None if force_per_current is None else Estimate(force_per_current, force_per_current, force_per_current)
    listed.append(
        EstimateRow("gripper.force_per_current_n_ma", "N/mA", scale, NO_SCALE if scale is None else "as given")
    )
    weights = [(one.source, one.weight) for one in grips if one.weight is not None]
    gel_rows, values = _gel(weights, misfits, priors, scale_n_ma)
    listed += gel_rows
    listed += [EstimateRow("normal_modulus_pa", "Pa", None, BENDS), EstimateRow("loss_tangent", "", None, QUIET)]
    if keys or force_per_current is not None:
        scale_from = "as given" if force_per_current is not None else "not estimated: the value of the sensor `like`"
        keys["force_per_current_n_ma"] = Entry(scale_n_ma, None, scale_from)
        values["gripper"] = Entry(keys, None, "forces are valid only for the force per current below")
    return listed, values


def _told(grips: Sequence[Gripped], part: str, why_none: str) -> tuple[Any, str]:
    """Return a part of the first recording with an estimate of it, and its name; None, and why, if there is none."""
    return next(((getattr(one, part), one.source) for one in grips if getattr(one, part) is not None), (None, why_none))


def _drive_rows(fit: DriveFit | None, source: str) -> list[EstimateRow]:
    """Return the rows of the drive, in terms of current."""
    units = {
        ("gripper: gear friction", "friction_ma"): ("mA", 1.0),
        ("gripper: damping", "damping_ma_s_m"): ("mA s/mm", 1e-3),
        ("gripper: moving mass", "mass_ma_s2_m"): ("mA s2/m", 1.0),
        ("gripper: bending of the fingers", "finger_ticks_ma"): ("ticks/mA", 1.0),
    }
    listed = []
    for (name, key), (unit, factor) in units.items():
        estimate = None if fit is None else _scaled(_of_drive(fit, key), factor)
        listed.append(EstimateRow(name, unit, estimate, source))
    estimate = None if fit is None else _backlash(fit)
    return [*listed, EstimateRow("gripper.backlash_ticks", "ticks", estimate, source)]


def _of_drive(fit: DriveFit, key: str) -> Estimate:
    """Return a value of the drive with an interval of two sd, or of the error found on simulated sensors."""
    value = fit.values[key]
    half = max(2 * fit.sd[key], LEAST_SHARE[key] * value)
    return Estimate(value, max(value - half, 0.0), value + half)


def _backlash(fit: DriveFit) -> Estimate:
    value = fit.values["backlash_ticks"] + BACKLASH_LOW_TICKS
    half = math.hypot(2 * fit.sd["backlash_ticks"], BACKLASH_TICKS)
    return Estimate(value, max(value - half, 0.0), value + half)


def _scaled(estimate: Estimate, factor: float) -> Estimate:
    return Estimate(*(factor * value for value in estimate))


def _within(value: float, share: float) -> Estimate:
    """Return a value with a relative uncertainty, symmetric as a factor."""
    return Estimate(value, value / (1 + share), value * (1 + share))


def _drive_keys(
    fit: DriveFit, gain: Estimate | None, usual: gripper.Drive, scale_n_ma: float, source: str
) -> dict[str, Entry]:
    """Return the keys of the gripper's table, in which forces are computed with the force per current."""
    gain_ma_tick = usual.gain_ma_tick if gain is None else gain.value
    servo_n_tick = gain_ma_tick * scale_n_ma
    two_ticks_n = min(TWO_TICKS_N, servo_n_tick)
    friction = _scaled(_of_drive(fit, "friction_ma"), scale_n_ma / (2 * servo_n_tick - two_ticks_n))
    bending = _of_drive(fit, "finger_ticks_ma")
    pitch_m = gripper.metres_per_tick(min(max(gripper.gap_m(fit.values["touch_ticks"]), 0.0), 0.104))
    stiffness = [scale_n_ma / (ticks * pitch_m) for ticks in (bending.value, bending.high, bending.low)]
    damping, mass = (_scaled(_of_drive(fit, key), scale_n_ma) for key in ("damping_ma_s_m", "mass_ma_s2_m"))
    backlash = _backlash(fit)
    gain_from = "not estimated" if gain is None else "from the grasp's goals"
    return {
        "servo_n_tick": Entry(servo_n_tick, None if gain is None else _scaled(gain, scale_n_ma), gain_from),
        "two_ticks_n": Entry(two_ticks_n, None, "the gear's friction is below"),
        "friction_factor": Entry(friction.value, friction, source),
        "damping_n_s_m": Entry(damping.value, damping, source),
        "mass_kg": Entry(mass.value, mass, source),
        "finger_stiffness_n_m": Entry(stiffness[0], Estimate(*stiffness), source),
        "backlash_ticks": Entry(backlash.value, backlash, source),
    }


def _gel(
    weights: Sequence[tuple[str, Weight]], misfits: Mapping[str, str], priors: Identify, scale_n_ma: float
) -> tuple[list[EstimateRow], dict[str, Entry]]:
    """Return rows and keys of the gel's shear modulus, creep and friction, from weights and their recordings."""
    values: dict[str, Entry] = {}
    modulus = friction = factor = total = None
    mass_kg = None if priors.object_mass_g is None else 1e-3 * priors.object_mass_g
    whys = [misfits.get("weight", misfits.get("drive", MAKE_GRIP))] * 4
    if weights:
        whys = [misfits.get("modulus", NO_MASS), misfits.get("creep", NO_CREEP), NO_MASS, NO_MASS]
    crept = [(source, one.creep) for source, one in weights if one.creep is not None]
    if crept:
        source = ", ".join(source for source, _ in crept)
        shares = np.mean([creep.share for _, creep in crept], axis=0) + CREEP_LOW_SHARE / 2
        time_s = np.exp(np.mean(np.log([creep.time_s for _, creep in crept]), axis=0))
        share, half = float(shares.sum()), math.hypot(CREEP_SHARE, CREEP_GRIP_SHARE / math.sqrt(len(crept)))
        total = Estimate(share, max(share - half, 0.0), share + half)
        about = f"both together {total.low:.3g} to {total.high:.3g}; {source}"
        values["creep"] = Entry({"share": shares, "time_s": time_s}, None, about)
        whys[1] = source
    pulled = next(((source, one.modulus_pa) for source, one in weights if one.modulus_pa is not None), None)
    if pulled is not None and mass_kg is not None:
        source, for_1_kg_pa = pulled
        scale_share = SCALE_SHARE if priors.pixel_mm is None else 0.0
        modulus_pa = for_1_kg_pa * mass_kg / (1 + MODULUS_HIGH_SHARE)
        modulus = _within(modulus_pa, math.hypot(MODULUS_SHARE, SCALE_POWER * scale_share))
        values["shear_modulus_pa"] = Entry(modulus.value, modulus, source)
        whys[0] = source
    if weights and mass_kg is not None:
        whys[2:] = [misfits.get("drive", MAKE_SLIP)] * 2
        slipped = [(source, one.weight_per_ma * mass_kg) for source, one in weights if one.weight_per_ma is not None]
        if slipped:
            friction = _friction([per_ma for _, per_ma in slipped])
            source = ", ".join(source for source, _ in slipped)
            whys[2] = source
            as_factor = _scaled(friction, 1 / (scale_n_ma * priors.object_friction))
            is_scale_given = priors.force_per_current is not None
            factor, whys[3] = (as_factor, source) if is_scale_given else (None, NO_SCALE)
            needs = source if is_scale_given else f"{source}; valid only for the force per current below"
            values["static_friction_factor"] = Entry(as_factor.value, factor, needs)
    quantities = [("shear_modulus_pa", "Pa", modulus), ("creep.share, both arms", "", total)]
    quantities += [("static friction x force per current", "N/mA", friction), ("static_friction_factor", "", factor)]
    return [EstimateRow(*one, why) for one, why in zip(quantities, whys, strict=True)], values


def _friction(per_ma: Sequence[Floats]) -> Estimate:
    """Return static friction times force per current, from the weight per mA at first and last time of each slip."""
    first, last = np.log(np.array(per_ma)).T
    gap = last - first
    middle = float(np.mean(last + SLIP_PART * gap))
    sd = math.hypot(GRIP_SD / math.sqrt(len(gap)), ALL_GRIPS_SD, SLIP_PART_SD * float(gap.mean()))
    half = float(stats.norm.ppf((1 + LEVEL) / 2)) * sd
    return Estimate(math.exp(middle), math.exp(middle - half), math.exp(middle + half))
