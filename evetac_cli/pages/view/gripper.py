"""Gripper of a trial in view: its motion, and for grasps the phases, the outcome and the side view."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.pages.shared import BLUE, GREEN, INK, ORANGE, PINK, inner
from evetac_cli.pages.view.event_images import read_rows
from evetac_cli.pages.view.time_series import decimated, first_row, lane_of, rows_of, slice_times_s, timed
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.pages.view.view_data import Lane, Panel, Series
from evetac_cli.store.recordings.read import Recording

TOUCH_N = 0.03  # normal force that counts as contact, as in `evaluate data-rate`
PHASES = (("contact", GraspPhase.CONTACT, INK), ("lift", GraspPhase.LIFT, BLUE), ("balance", GraspPhase.BALANCE, GREEN))


def gripper_panels(trial: OpenTrial, span: tuple[int, int]) -> list[Panel]:
    """Return current and width; for grasps goal and position instead of width, and the object's height and motion."""
    recording = trial.recording
    if recording is None or not recording.has("gripper"):
        return []
    simulated = bool(recording.header["simulated"])
    t_s, first, _ = timed(recording, "gripper/t_us", span)
    position = decimated({"position": BLUE}, t_s, rows_of(recording, "gripper/position_ticks", first))

    def currents(start: int, stop: int) -> NDArray[Any]:
        names = ("current_ma", "current_target_ma")
        return np.stack([recording.read(f"gripper/{name}", first + start, first + stop) for name in names], axis=1)

    measured = decimated({"measured": ORANGE, "target": INK}, t_s, currents)
    current = Panel("Gripper, current", "mA", measured, {}, simulated)
    if not recording.has("control"):
        from evetac_cli.sim.gripper import gap_m

        width = [
            Series("width", line.colour, line.t_s, np.array([1000 * gap_m(value) for value in line.value]))
            for line in position
        ]
        return [current, Panel("Gripper, width between the fingers", "mm", width, {}, simulated)]
    control_s, first_step, _ = timed(recording, "control/t_us", span)
    goal = decimated({"goal": INK}, control_s, rows_of(recording, "control/goal_ticks", first_step))
    panels = [Panel("Gripper, goal and position (up closes)", "ticks", [*goal, *position], {}, simulated), current]
    start, slices_s = span[0], slice_times_s(*span)
    if recording.has("truth/table_gap_mm"):
        heights = decimated({"height": GREEN}, slices_s, rows_of(recording, "truth/table_gap_mm", start))
        panels.append(Panel("Object, height above the table, truth", "mm", heights, {}, simulated=True))
    scale, touched = _mm_per_px(trial), _gripped_at(recording)
    if scale is not None and touched is not None and recording.has("truth/object_xy_px"):
        origin = recording.read("truth/object_xy_px", touched, touched + 1)

        def moved(begin: int, end: int) -> NDArray[Any]:
            away = np.hypot(*(recording.read("truth/object_xy_px", start + begin, start + end) - origin).T) * scale
            away[np.arange(start + begin, start + end) < touched] = np.nan
            return np.asarray(away[:, None])

        lines = decimated({"moved": PINK}, slices_s, moved)
        panels.append(Panel("Object, moved in the gripper since the grip, truth", "mm", lines, {}, simulated=True))
    return panels


def _mm_per_px(trial: OpenTrial) -> float | None:
    scale = inner(trial.recording_parameters, "sensor_row", "mm_per_px")
    return float(scale) if isinstance(scale, (int, float)) else None


def _gripped_at(recording: Recording) -> int | None:
    """Return the last slice of light contact in a grasp; None if it never ends."""
    phase = recording.read("control/phase")
    light = np.flatnonzero(phase == GraspPhase.CONTACT)
    if not len(light) or light[-1] + 1 == len(phase):
        return None
    return min(int(recording.read("control/t_us")[light[-1]] // SLICE_US), len(recording) - 1)


def phase_lanes(trial: OpenTrial, span: tuple[int, int]) -> list[Lane]:
    """Return when a grasp was in each of its phases."""
    recording = trial.recording
    if recording is None or not recording.has("control"):
        return []
    t_s, first, last = timed(recording, "control/t_us", span)
    phase, ends_s = recording.read("control/phase", first, last)[:, None], np.append(t_s, span[1] / SLICES_PER_S)
    lanes = [
        lane_of(name, colour, ends_s, lambda begin, end, number=number: phase[begin:end] == number)  # type: ignore[misc]
        for name, number, colour in PHASES
    ]
    return [lane for lane in lanes if lane.slip]


def contact_times(trial: OpenTrial, span: tuple[int, int]) -> dict[str, int]:
    """Return when the object was gripped, or first touched; a page opens there if nothing slips."""
    recording = trial.recording
    times: dict[str, int | None] = {}
    if recording is None:
        return {}
    if recording.has("control"):
        times["gripped"] = _gripped_at(recording)
    if recording.has("truth/normal_force_n"):
        force = rows_of(recording, "truth/normal_force_n", span[0])
        touched = first_row(span[1] - span[0], force, lambda force_n: force_n >= TOUCH_N)
        times["first touch"] = span[0] + touched if touched else None  # contact from the start is not a first touch
    return {name: at for name, at in times.items() if at is not None and span[0] <= at < span[1]}


def outcome_badges(trial: OpenTrial) -> list[tuple[str, str]]:
    """Return the outcome of a grasp in its recording; empty if there is none."""
    recording = trial.recording
    if recording is None or not recording.has("control/outcome"):
        return []
    try:
        outcome = json.loads(recording.read("control/outcome"))
    except InputError:
        return []
    lifted, balanced = (bool(outcome.get(name)) for name in ("lifted", "balanced"))
    shown = [("grasp", "held to the end" if balanced else "lost in balance" if lifted else "not lifted")]
    for name, key, unit in (("moved", "moved_mm", "mm"), ("grip at the end", "force_end_n", "N")):
        if balanced and isinstance(outcome.get(key), (int, float)):
            shown.append((name, f"{outcome[key]:.2g} {unit}"))
    return shown


def side_view(trial: OpenTrial, ends: NDArray[np.int64]) -> dict[str, Any] | None:
    """Return the grasp from the side at the end of each image; None without full truth, or for sideways grasps.

    object: its width between the fingers and its height in mm; arrays (frames,): its height above the table and how far
    it has sunk in the gripper since the start, in mm, and the force of one finger in N, at most `most_n`.
    """
    recording, parameters, scale = trial.recording, trial.recording_parameters, _mm_per_px(trial)
    if recording is None or scale is None or not recording.has("truth/table_gap_mm"):
        return None
    row = inner(parameters, "object_row") or {}
    width, height = row.get("grasped_width_mm", row.get("width_mm")), row.get("height_mm")
    if not (isinstance(width, (int, float)) and isinstance(height, (int, float))):
        return None
    if inner(parameters, "scene", "gel", "sideways"):
        return None
    heights, forces, moved = (
        read_rows(recording, f"truth/{name}", ends, np.nan)
        for name in ("table_gap_mm", "normal_force_n", "object_xy_px")
    )
    return {
        "object": [float(width), float(height)],
        "most_n": max(float(np.nanmax(forces, initial=0.0)), 1e-9),
        "height": heights,
        "sunk": moved[:, 0] * scale,
        "force": forces,
    }
