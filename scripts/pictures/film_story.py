"""Choose the content of the film (film.py): which catch, which stretches of time, and their playback speeds."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.sim.setup.plan import read_plan

PICTURE_MS = 50  # time per picture: 20 pictures per second
BALANCE = 2  # value of control/phase
HELD_MS = 300  # a slide counts as caught if the object still hangs this long after it


class Act(NamedTuple):
    """A stretch of the recording, [start, stop) in ms, and its playback speed as a multiple of real time."""

    name: str
    start_ms: int
    stop_ms: int
    speed: float


class Catch(NamedTuple):
    """A slide that ended: its first slice, the first slice after it, and the distance of the slide."""

    onset_ms: int
    stuck_ms: int
    slid_mm: float


@dataclass(frozen=True)
class Story:
    """The data that the film needs of a recording and its tracks, slice by slice; heights in mm are of the object."""

    title: str
    catch: Catch
    acts: list[Act]
    object_mm: tuple[float, float]  # width between the fingers, height
    mm_per_px: float
    window_px: tuple[int, int, int, int] | None
    frame_px: tuple[int, int]
    rest_xy_px: NDArray[np.float64]  # (dots, 2)
    columns: int  # columns of the dot grid; dots are row-major
    height_mm: NDArray[np.float32]  # object above the table
    down_px: NDArray[np.float32]  # object relative to the hand, downwards, in camera px
    force_n: NDArray[np.float32]  # normal force of one finger
    probability: NDArray[np.float32]
    noticed_ms: int  # when the controller first received the slip signal
    position_ticks: NDArray[np.int32]  # of the gripper
    goal_ticks: NDArray[np.int32]  # commanded to the gripper


def farthest_catch(
    slip: NDArray[np.integer], down_mm: NDArray[np.floating], height_mm: NDArray[np.floating]
) -> Catch | None:
    """Return the farthest slide whose object still hangs HELD_MS later; None if none slid, or all were dropped."""
    edges = np.flatnonzero(np.diff(np.r_[0, np.asarray(slip) > 0, 0]))
    catches = [
        Catch(onset, stuck, float(down_mm[stuck] - down_mm[onset]))
        for onset, stuck in edges.reshape(-1, 2).tolist()
        if stuck + HELD_MS < len(slip) and height_mm[stuck + HELD_MS] > 1.0 and height_mm[onset] > 1.0
    ]
    return max(catches, key=lambda catch: catch.slid_mm, default=None)


def acts(catch: Catch, rise_ms: int, slices: int) -> list[Act]:
    """Return the acts and their speeds: one picture per millisecond around the catch."""
    loosening, slow, held = catch.onset_ms - 340, catch.onset_ms - 20, catch.stuck_ms + 40
    plan = [
        Act("lift", max(rise_ms - 150, 0), loosening, 4.0),
        Act("loosening", loosening, slow, 0.25),
        Act("catch", slow, held, 0.02),
        Act("held", held, min(held + 600, slices), 1.0),
    ]
    if any(act.start_ms >= act.stop_ms for act in plan):
        raise InputError(
            "there is too little time before or after this catch for the film",
            expected="a slide at least half a second after the object was lifted, and time after it",
            found=f"lifted at {rise_ms} ms, slid from {catch.onset_ms} to {catch.stuck_ms} ms of {slices}",
        )
    return plan


def frame_times(plan: list[Act]) -> list[float]:
    """Return the recorded time at the end of every picture, in ms."""
    return [float(at) for act in plan for at in np.arange(act.start_ms, act.stop_ms, act.speed * PICTURE_MS)]


def read_story(trial: OpenTrial) -> Story:
    """Read all data except events; InputError if the recording is no simulated grasp, lacks tracks, or has no catch."""
    recording, tracks = trial.recording, trial.tracks
    if recording is None or not (recording.has("control") and recording.has("truth/table_gap_mm")):
        raise InputError("the film needs a simulated grasp", expected="a recording made by evetac grasp")
    if tracks is None:
        raise InputError("there are no tracks next to the recording", where=str(recording.path), hint="evetac track")

    def held(clock: str, path: str) -> NDArray[Any]:
        """Return the latest value at every slice of a dataset with its own clock."""
        rows = np.searchsorted(recording.read(clock), np.arange(len(recording)) * SLICE_US, side="right") - 1
        values: NDArray[Any] = recording.read(path)[np.maximum(rows, 0)]
        return values

    made = read_plan(recording.header["parameters"], str(recording.path))
    object, mm_per_px = made.object, made.sensor.mm_per_px
    assert object is not None
    if made.scene.gel.sideways or made.scene.drop is not None:
        raise InputError(
            "the film supports only grasps from the top, without a falling weight", where=str(recording.path)
        )
    height = recording.read("truth/table_gap_mm")
    down_px = recording.read("truth/object_xy_px")[:, 0]
    slip = recording.read("truth/slip")
    slip[held("control/t_us", "control/phase") != BALANCE] = 0  # the grip loosens only in this phase
    catch = farthest_catch(slip, down_px * mm_per_px, height)
    if catch is None:
        raise InputError(
            "the recording has no slide that was caught in the balance phase",
            where=str(recording.path),
            hint="another object or seed",
        )
    rise_ms = int(np.flatnonzero(height > 0.05)[0])
    plan = acts(catch, rise_ms, len(recording))
    grid = tracks.read("sensor/dot_xy_px")
    heard_ms = recording.read("control/t_us")[recording.read("control/slip") > 0] // SLICE_US
    heard_ms = np.append(heard_ms[heard_ms >= plan[2].start_ms], catch.stuck_ms)
    return Story(
        title=f"Catching object {made.object_name} by feel: {object.material}, {object.mass_g:g} g",
        catch=catch,
        acts=plan,
        object_mm=(
            object.held_mm,
            object.height_mm,
        ),
        mm_per_px=mm_per_px,
        window_px=recording.window_px,
        frame_px=recording.frame_px,
        rest_xy_px=grid.reshape(-1, 2),
        columns=grid.shape[1],
        height_mm=height,
        down_px=down_px,
        force_n=recording.read("truth/normal_force_n"),
        probability=recording.read("control/probability"),
        noticed_ms=int(heard_ms[0]),
        position_ticks=held("gripper/t_us", "gripper/position_ticks"),
        goal_ticks=held("control/t_us", "control/goal_ticks"),
    )
