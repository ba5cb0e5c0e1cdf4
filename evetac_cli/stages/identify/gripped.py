"""Estimates from a gripper that closes, holds an object of known mass and lets it slip.

The gripper's rows alone determine its drive, in terms of current. The dots show how far the weight pulls the gel, its
creep, and when the object slips. Only the weight is a known force; parameters that depend on the normal force also need
the force per current.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.estimates import Estimate
from evetac_cli.kernels.identify import gripper, held_gel
from evetac_cli.kernels.identify.held_gel import Creep, HeldFit
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.setup.sensor import PAD_M
from evetac_cli.stages.identify import drive
from evetac_cli.stages.identify.drive import DriveFit, GripperRows
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.store.recordings.read import Recording

STEP_MS = 1.0  # a simulated command takes effect in the next ms
PAD_NODES = (36, 27)  # columns and rows
LONGEST_MS = 120_000  # time that is used
SHORTEST_HOLD_MS = 3000  # at one current, during which the weight is applied
AROUND_MS = 300  # before and after the weight is applied
LEAST_STEP_PX = 0.3
BLOCK_SLICES = 10  # during which dots are assumed not to move
RIM_PX = 5.0  # width on either side of a dot's rim in which its events are counted
QUIET_MS, BUSY_EVENTS = 400, 5  # a pixel with more events before the weight is applied is hot
GONE = 0.8  # share of the largest displacement below which the object has slipped
SLIPS_AT = (0.98, 0.95)  # shares of the largest displacement; the times when they were last reached are used
PADS = 2
# Largest residuals of a good fit: two to three times the largest found on simulated sensors (randomized:100 to 114).
MOST_OFF_TICKS = 2.0  # of the drive, rms
MOST_OFF_SHARE = 0.5  # of the dots' displacement, rms share
MOST_OFF_IN_TIME = 0.0075  # of the displacement under the weight over time, rms share


class Weight(NamedTuple):
    """Response of the gel to a weight: creep, shear modulus, and the force per mA at which the object slipped.

    creep, modulus_pa: None if the fit is bad. modulus_pa, weight_per_ma: for a weight of 1 kg; the latter at each of
    SLIPS_AT, None if the object did not slip or the drive is unknown.
    """

    creep: Creep | None
    modulus_pa: float | None
    weight_per_ma: Floats | None


@dataclass(frozen=True)
class Gripped:
    """Estimates from one recording; each part is None if it could not be estimated.

    misfits: reasons why the drive, the gain, the weight as a whole, or its modulus or creep cannot be estimated.
    """

    source: str
    drive: DriveFit | None = None
    encoder_ticks: Estimate | None = None
    delay_ms: Estimate | None = None
    jitter_ms: Estimate | None = None
    gain_ma_tick: Estimate | None = None
    weight: Weight | None = None
    misfits: Mapping[str, str] = field(default_factory=dict)


def find(recording: Recording, mm_per_px: float, rng: np.random.Generator) -> Gripped | None:
    """Return the estimates of gripper and gel from a recording with gripper rows, without using `truth`.

    None if there are no rows, or if a current is not finite.
    """
    source = recording.path.name
    time_us = recording.read("gripper/t_us")
    looked_at = slice(0, int(np.searchsorted(time_us, 1000 * LONGEST_MS)))
    rows = GripperRows(
        time_us[looked_at],
        recording.read("gripper/current_written_ma")[looked_at].astype(np.float64),
        recording.read("gripper/current_ma")[looked_at].astype(np.float64),
        recording.read("gripper/position_ticks")[looked_at].astype(np.int64),
    )
    if not (len(rows.time_us) and np.isfinite(rows.measured_ma).all()):
        return None
    if not np.isfinite(recording.read("gripper/current_target_ma")).all():  # commanded by goals: a grasp
        try:
            return Gripped(source, gain_ma_tick=_gain(recording, rows, rng))
        except ValueError as error:
            why = f"cannot be estimated from {source}: {error}; make one with evetac grasp --controller fixed:6"
            return Gripped(source, misfits={"gain": why})
    delay = jitter = noise = None
    between_ms = gripper.lateness(rows.time_us, rows.commanded_ma, rows.measured_ma, STEP_MS)
    with suppress(ValueError):  # too few commands
        delay, jitter = gripper.delay_and_jitter(between_ms)
    try:
        fitted = drive.fit(rows)
    except ValueError as error:  # it does not close on an object and open again
        return Gripped(source, delay_ms=delay, jitter_ms=jitter, misfits={"drive": _why(source, error)})
    drive_fit: DriveFit | None = fitted
    misfits = {}
    if fitted.residual_ticks > MOST_OFF_TICKS:
        drive_fit = None
        off = f"residual {fitted.residual_ticks:.1f} ticks, at most {MOST_OFF_TICKS:g} allowed"
        misfits["drive"] = f"cannot be estimated: no simulated drive moves as this gripper did ({off})"
    else:
        with suppress(ValueError):  # it never rests
            noise = gripper.encoder_noise(fitted.rests)
    weight, of_weight = _weight(recording, rows, drive_fit, mm_per_px)
    return Gripped(source, drive_fit, noise, delay, jitter, None, weight, misfits | of_weight)


def _why(source: str, reason: object) -> str:
    """Return the note why a recording does not allow the estimates of a grip."""
    return f"cannot be estimated from {source}: {reason}; make one like the scene grip-steps (docs/identify.md)"


def _gain(recording: Recording, rows: GripperRows, rng: np.random.Generator) -> Estimate:
    """Return the servo's gain from recorded goals, as in a grasp; ValueError if they are missing or insufficient."""
    if not recording.has("control/goal_ticks"):
        raise ValueError("it has no goals of the gripper")
    count = len(rows.time_us)
    goals, times = recording.read("control/goal_ticks")[:count], recording.read("control/t_us")[:count]
    if not np.array_equal(times, rows.time_us):
        raise ValueError("the times of its goals differ from those of its gripper rows")
    return gripper.servo_gain(
        rows.time_us, goals.astype(np.float64), rows.place_ticks.astype(float), rows.measured_ma, rng
    )


def _weight(
    recording: Recording, rows: GripperRows, fitted: DriveFit | None, mm_per_px: float
) -> tuple[Weight | None, dict[str, str]]:
    """Return the gel's response to the weight of the held object, None if no weight is applied, and the reasons."""
    source = recording.path.name
    first_ms, last_ms = _longest_hold(rows)
    last_ms = min(last_ms, len(recording))
    if recording.dot_xy_px is None or recording.dot_radius_px is None:
        return None, {"weight": f"cannot be estimated from {source}: it has no dot grid; {MAKE_GRID} to evetac record"}
    if last_ms - first_ms < SHORTEST_HOLD_MS:
        return None, {"weight": _why(source, f"no current is held for {SHORTEST_HOLD_MS / 1000:g} s")}
    try:
        moved_px = _tracked(recording)
        along, came_ms, loaded_ms = _loading(moved_px[first_ms:last_ms])
        came_ms += first_ms
        sign = 1.0 if along > 0 else -1.0
        axis = abs(along) - 1
        rest_px = moved_px[came_ms - 200 : came_ms - 10].mean(axis=0)
        moved_m = (moved_px - rest_px)[..., axis] * (sign * mm_per_px * 1e-3)
        width, height = recording.frame_px
        dot_m = (recording.dot_xy_px.reshape(-1, 2) - np.array([width, height]) / 2) * (mm_per_px * 1e-3)
        end_ms = last_ms - 50
        gel_fit = held_gel.fit(
            _pad(recording, mm_per_px, axis),
            dot_m if axis == 0 else dot_m[:, ::-1],
            moved_m[end_ms - 500 : end_ms].mean(0),
        )
        weight = np.nan_to_num(gel_fit.moved)
        displacement_m = np.nan_to_num(moved_m) @ (weight / (weight**2).sum())
        seen = _seen_motion(recording, moved_px, came_ms - AROUND_MS // 3, end_ms)[AROUND_MS // 3 :]
        both = displacement_m[came_ms:end_ms] / displacement_m[end_ms - 500 : end_ms].mean() + seen / seen[-500:].mean()
        creep = held_gel.creep(*_thinned(both[loaded_ms:] / 2), loaded_ms * 1e-3)
    except ValueError as error:  # the motion is not that of a held object
        return None, {"weight": _why(source, error)}
    misfits = _misfits(gel_fit, creep)
    modulus_pa = GRAVITY_M_S2 / PADS / (creep.final * gel_fit.displacement_m * gel_fit.stiffness_m)
    slips_ms = _slips(displacement_m[last_ms:])
    per_ma = None
    if slips_ms is not None and fitted is not None:
        at = np.minimum(slips_ms + last_ms - int(rows.time_us[0] // SLICE_US), len(fitted.force_ma) - 1)
        force_ma = fitted.force_ma[at]
        per_ma = GRAVITY_M_S2 / PADS / force_ma if (force_ma > 0).all() else None
    known_creep = None if "creep" in misfits else creep
    return Weight(known_creep, None if "modulus" in misfits else modulus_pa, per_ma), misfits


def _misfits(gel_fit: HeldFit, creep: Creep) -> dict[str, str]:
    """Return the reasons why modulus and creep cannot be estimated with a bad fit; the modulus also needs the creep."""
    misfits = {}
    if creep.misfit > MOST_OFF_IN_TIME:
        off = f"residual {creep.misfit:.1%}, at most {MOST_OFF_IN_TIME:.2%} allowed"
        why = f"cannot be estimated: no gel with two creep times moves as this one did under the weight ({off})"
        misfits = {"creep": why, "modulus": why}
    if gel_fit.misfit > MOST_OFF_SHARE:
        off = f"residual {gel_fit.misfit:.0%}, at most {MOST_OFF_SHARE:.0%} allowed"
        misfits["modulus"] = (
            f"cannot be estimated: no strip of contact moves the dots as they moved under the weight ({off})"
        )
    return misfits


def _longest_hold(rows: GripperRows) -> tuple[int, int]:
    """Return first and last ms of the longest time with one commanded current."""
    changes = np.flatnonzero(np.diff(rows.commanded_ma) != 0) + 1
    edges = np.concatenate([[0], changes, [len(rows.time_us) - 1]])
    longest = int(np.argmax(np.diff(rows.time_us[edges])))
    first, last = rows.time_us[edges[longest]], rows.time_us[edges[longest + 1]]
    return int(first // SLICE_US), int(last // SLICE_US)


def _tracked(recording: Recording) -> NDArray[np.float32]:
    """Return the position of every dot at the end of each slice, (slices, dots, 2)."""
    dots, radius_px = recording.dot_xy_px, recording.dot_radius_px
    assert dots is not None and radius_px is not None
    constants = presets.PRESETS["stable"].for_dots(radius_px)
    state = tracker.start(dots.reshape(-1, 2), constants, frame_px=recording.frame_px)
    slices = min(len(recording), LONGEST_MS)
    place = np.empty((slices, len(dots.reshape(-1, 2)), 2), np.float32)
    for events, at_end in zip(recording, place, strict=False):
        tracker.step(state, events.x, events.y, events.p)
        at_end[:] = state.dot_xy_px
    return place


def _loading(place_px: NDArray[np.float32]) -> tuple[int, int, int]:
    """Return the direction of the weight (1 or 2: x or y, negative against it), its onset, and its rise time in ms."""
    mean_px = np.nanmean(place_px, axis=1)
    if len(mean_px) < 4 * AROUND_MS:
        raise ValueError("the hold is too short")
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(mean_px, axis=0)])
    third = AROUND_MS // 3
    smooth = (sums[third:] - sums[:-third]) / third
    step = smooth[2 * third :] - smooth[: -2 * third]
    middle, axis = (int(place) for place in np.unravel_index(np.argmax(np.abs(step)), step.shape))
    rises = float(step[middle, axis])
    if abs(rises) < LEAST_STEP_PX:
        raise ValueError("no weight is applied")
    first = max(middle - AROUND_MS // 2, 0)
    path = (mean_px[first : first + 3 * AROUND_MS, axis] - smooth[middle, axis]) / rises
    begin = int(np.argmax(path > 0.03))
    full = begin + int(np.argmax(path[begin:] > 0.95))
    if first + begin < 210 or full <= begin:
        raise ValueError("the weight was applied before the hold began")
    return (axis + 1) * (1 if rises > 0 else -1), first + begin, max(round((full - begin) / 0.92), 1)


def _seen_motion(recording: Recording, place_px: NDArray[np.float32], first: int, stop: int) -> Floats:
    """Return the motion of all dots along the weight since slice `first`, in slices up to `stop`, in arbitrary units.

    Events on the rims of the dots are summed, with opposite signs for ON and OFF and for the two sides of a dot. A
    tracker hardly follows a creep of 0.01 px per second, which causes one event per slice, but the sum does.
    """
    radius_px = recording.dot_radius_px
    assert radius_px is not None
    busy = _busy(recording, max(first - QUIET_MS, 0), first)
    direction = np.nanmean(place_px[stop - 1] - place_px[first], axis=0)
    direction /= max(float(np.hypot(*direction)), 1e-9)
    sums = np.zeros(stop - first)
    total = 0.0
    for block in recording.blocks(BLOCK_SLICES, first, stop):
        events, start, end = block.events, block.first, block.stop
        usual = ~busy[events.y, events.x]
        x, y = events.x[usual].astype(np.float32), events.y[usual].astype(np.float32)
        dots = place_px[(start + end) // 2]
        off_x, off_y = x[:, None] - dots[:, 0], y[:, None] - dots[:, 1]
        distance = np.hypot(off_x, off_y)
        distance[np.isnan(distance)] = np.inf
        at = np.arange(len(x)), distance.argmin(axis=1)
        rim = np.abs(distance[at] - radius_px) < RIM_PX
        side = (off_x[at] * direction[0] + off_y[at] * direction[1])[rim] / distance[at][rim]
        total += float(side @ (1.0 - 2.0 * events.p[usual][rim]))
        sums[start - first : end - first] = total
    return sums


def _busy(recording: Recording, first: int, stop: int) -> NDArray[np.bool_]:
    """Return which pixels (rows, columns) are hot, with many events while nothing moves."""
    width, height = recording.frame_px
    events = recording.between(first, stop)
    counts = np.bincount(events.y.astype(np.int64) * width + events.x, minlength=width * height)
    return counts.reshape(height, width) >= BUSY_EVENTS


def _pad(recording: Recording, mm_per_px: float, axis: int) -> held_gel.Pad:
    """Return the gel pad, with its x along the weight; it ends at the window, like that of a simulated sensor."""
    width, _ = recording.frame_px
    window = recording.window_px
    end_m = ((window[0] if window is not None else width) - width / 2) * mm_per_px * 1e-3
    across, down = (end_m - PAD_M[0], end_m), (-PAD_M[1] / 2, PAD_M[1] / 2)
    columns, rows = PAD_NODES
    nodes = contact.pad_nodes(columns, rows, across, down)
    if axis == 1:
        nodes = contact.pad_nodes(rows, columns, down, across)
    return held_gel.Pad(nodes, gel.GelMaterial.height_m)


def _thinned(displacement_m: Floats) -> tuple[Floats, Floats]:
    """Return times in s since the weight was applied, evenly spaced in the logarithm, and mean displacements."""
    if len(displacement_m) < 1000:
        raise ValueError("the weight does not hang long enough")
    edges = np.unique(np.round(np.geomspace(20, len(displacement_m), 40)).astype(int))
    sums = np.concatenate([[0.0], np.cumsum(displacement_m)])
    return (edges[1:] + edges[:-1]) / 2e3, np.diff(sums[edges]) / np.diff(edges)


def _slips(displacement_m: Floats) -> NDArray[np.int64] | None:
    """Return the slices in which the gel springs back to SLIPS_AT because the object slips; None without slip."""
    if len(displacement_m) < 20:
        return None
    smooth = np.convolve(displacement_m, np.ones(10) / 10, mode="valid")
    largest = np.maximum.accumulate(smooth)
    gone = np.flatnonzero(smooth < GONE * largest)
    if not len(gone):
        return None
    before = smooth[: gone[0]]
    return np.array([np.flatnonzero(before >= level * largest[gone[0]])[-1] + 5 for level in SLIPS_AT])
