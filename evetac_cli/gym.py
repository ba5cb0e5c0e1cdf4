"""The paper's task as a Gymnasium environment: lift an object by touch, then hold it with as little force as possible.

    import gymnasium
    import evetac_cli.gym

    env = gymnasium.make("evetac/Lift-v0")
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

Importing this module registers the environment. Everything in it is simulated: it runs the loop of `grasp` in a scene
of kind lift, with the agent in place of the controller.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.errors import InputError, missing_library
from evetac_cli.events import FRAME_PX, SLICE_US, SLICES_PER_S, Events, concatenate, empty
from evetac_cli.kernels.grip.control import Control, FixedGrip, SlipSignal
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.grasp_outcome import LIFTED_MM
from evetac_cli.sim.setup.plan import plans
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.store.files import StageFile
from evetac_cli.trials.grasp.loop import Timing, grasp_slices

try:
    import gymnasium
    from gymnasium import spaces
except ModuleNotFoundError as error:
    raise missing_library(error) or error from None

Observation = dict[str, NDArray[np.float32]]

MOST_TICKS = 60.0  # largest goal beyond light contact, in ticks: about 14 N
FARTHEST_PX, MOST_EVENTS, MOST_READ = 200.0, 1000.0, 2000.0  # limits of observations: px, events per ms, ticks or mA
COST_N_S, COST_MM = 0.04, 0.05  # cost of each N s of force and of each mm that the object moves in the hand
LOST_MM = 20.0  # an object that moved this far in the hand is lost; further motion costs no more
TRUTH = ("truth/table_gap_mm", "truth/normal_force_n", "truth/object_xy_px")


class _Chosen(Control):
    """A controller that makes contact like all others and then returns the goal chosen by the agent."""

    goal = 0

    def step(self, phase: GraspPhase, signal: SlipSignal, position_ticks: int) -> int:
        """Return the goal in ticks."""
        own = super().step(phase, signal, position_ticks)
        return own if phase is GraspPhase.CONTACT else self.goal


class LiftEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Environment: lift an object after light contact, and hold it with little force and little slip.

    A hand rises by 100 mm while the fingers hold an object of unknown mass and friction. The episode begins at light
    contact. It is terminated if the object was not lifted by the end of the lifting phase, or if it fell. It is
    truncated at the end of the balancing phase.

    - objects: numbers and files as for `--object`. One of them is drawn at random for each episode, or chosen by its
      number or name with options={"object": NUMBER}.
    - mass_factor: range of a random factor on its mass.
    - sensor, gel, model: as for `evetac grasp`.
    - scene: a scene of kind lift; its hand rises with hand_mm_s instead of the paper's 20 mm/s.
    - lift_s, balance_s: durations of the two phases; the paper's are 10 s and 20 s.
    - control_hz: steps per second; the paper's rate is 500.
    - InputError: an argument is invalid.

    Action, (1,) in [0, 1]: the gripper's goal as a fraction of 60 ticks beyond light contact, rounded to whole ticks.

    Observation, from the detector and the gripper, all float32:

    - displacement_px (dots, 2): displacement of the tracked dots from rest.
    - events_per_dot (dots,): mean over the slices of the step.
    - slip (2,): largest slip probability, and share of slices with slip, since the last step.
    - gripper (2,): closing since light contact in ticks, and motor current in mA.
    - time_s (1,): time since the lift began.

    Reward: 1 for an object that hangs more than 50 mm above the table at the end of the lift, and 1 if it still does
    at the end of the episode. The cost is 0.04 for each N s of one finger's normal force, and 0.05 for each of the
    first 20 mm that the object moves in the hand. Force and motion are the simulation's ground truth. `info` contains
    them too, and the random choices.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        objects: str = "1-9",
        sensor: str = "evetac",
        *,
        scene: str = "lift",
        gel: str | None = None,
        mass_factor: tuple[float, float] = (0.5, 4.0),
        hand_mm_s: float = 100.0,
        lift_s: float = 2.0,
        balance_s: float = 2.0,
        control_hz: float = 50.0,
        model: Path | str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._plans = {
            each.object_name: replace(each, scene=_varied(each.scene, mass_factor, hand_mm_s, lift_s))
            for each in plans(scene, objects, sensor, ("lift",), gel)
        }
        plan = next(iter(self._plans.values())).of_trial((0,))
        self._durations = {"lift_s": float(lift_s), "balance_s": float(balance_s)}
        touch_s = plan.scene.time.touch_s
        touch_ms, lift_ms, balance_ms = (round(SLICES_PER_S * each) for each in (touch_s, lift_s, balance_s))
        self._timing = Timing(touch_ms, lift_ms, balance_ms, control_hz)
        if self._timing.balance_ms < 0:
            raise InputError("too short", where="balance_s", expected="0 s or more", found=f"{balance_s} s")
        self._model = resources.model_file(model, flag="model")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError("unknown value", where="render_mode", expected="rgb_array or None", found=str(render_mode))
        self.render_mode = render_mode
        dots = dot_grid(plan.sensor, plan.scene.gel.cut).reshape(-1, 2).shape[0]
        self.action_space = spaces.Box(0.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Dict(  # type: ignore[assignment]
            {
                "displacement_px": spaces.Box(-FARTHEST_PX, FARTHEST_PX, (dots, 2), np.float32),
                "events_per_dot": spaces.Box(0.0, MOST_EVENTS, (dots,), np.float32),
                "slip": spaces.Box(0.0, 1.0, (2,), np.float32),
                "gripper": spaces.Box(-MOST_READ, MOST_READ, (2,), np.float32),
                "time_s": spaces.Box(0.0, float(lift_s + balance_s), (1,), np.float32),
            }
        )
        self._dots = dots
        self._playing: Iterator[tuple[Events, dict[str, Any]]] | None = None
        self._events = empty()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Place an object and touch it lightly; the seed determines all random choices."""
        from evetac_cli.devices.simulated import SimulatedGripper, rig
        from evetac_cli.kernels.tracking import presets
        from evetac_cli.stages.model_files import chosen_threshold, require_useful
        from evetac_cli.trials.grasp.online_detector import open_detector

        super().reset(seed=seed)
        names = list(self._plans)
        object_name = names[int(self.np_random.choice(len(names)))]
        seeds = [int(part) for part in self.np_random.integers(2**31, size=4)]
        if options and "object" in options:
            object_name = options["object"]
            if object_name not in self._plans:
                listed = ", ".join(map(str, self._plans))
                raise InputError("not one of the objects", where="options", expected=listed, found=f"{object_name}")
        plan = self._plans[object_name].of_trial(seeds)
        self._mm_per_px = plan.sensor.mm_per_px
        devices = rig(plan, np.random.SeedSequence(seeds), **self._durations)
        assert isinstance(devices.gripper, SimulatedGripper)
        self._gripper = devices.gripper
        with StageFile(self._model, "model") as model:
            require_useful(model)
            self._detector = open_detector(
                model, devices.camera.sensor, presets.PRESETS["stable"], chosen_threshold(model)
            )
        self._control = _Chosen(FixedGrip(0), self._timing.control_hz)
        self._playing = grasp_slices(devices, self._detector, self._control, self._timing)
        self._sample = {"object": object_name, "mass_kg": json.loads(devices.sampled)["mass_kg"], "simulated": True}
        self._lifted = False
        self._moved_mm = 0.0
        self._slices = 0
        rows = self._play(self._timing.touch_ms)
        self._touch_ticks = self._gripper.read().position_ticks
        self._object_mm = self._object_now_mm(rows)
        return self._observation(), dict(self._sample)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Set the gripper's goal and simulate until the next step of control."""
        if self._playing is None:
            raise gymnasium.error.ResetNeeded("the episode is over or has not started: call reset()")
        share = float(np.clip(np.asarray(action, np.float64).reshape(-1)[0], 0.0, 1.0))
        if np.isnan(share):
            raise InputError("not a number", where="action", expected="0 to 1", found=f"{action}")
        self._control.goal = self._touch_ticks + round(MOST_TICKS * share)
        timing, before = self._timing, self._slices
        rows = self._play(min(timing.every_ms, timing.end_ms - self._slices))
        ended = self._slices >= timing.end_ms
        fell = self._gripper.simulation.finished and not ended
        hangs = rows["truth/table_gap_mm"][-1] > LIFTED_MM and rows["truth/normal_force_n"][-1] > 0.0
        object_mm = self._object_now_mm(rows)
        paid_mm = min(self._moved_mm, LOST_MM)
        self._moved_mm += float(np.hypot(*(object_mm - self._object_mm)))
        self._object_mm = object_mm
        force_n_s = float(np.sum(rows["truth/normal_force_n"])) * SLICE_US * 1e-6
        reward = -COST_N_S * force_n_s - COST_MM * (min(self._moved_mm, LOST_MM) - paid_mm)
        lift_ends = timing.touch_ms + timing.lift_ms
        if before < lift_ends <= self._slices:
            self._lifted = bool(hangs and not fell)
            reward += float(self._lifted)
        balanced = bool(ended and self._lifted and hangs)
        reward += float(balanced)
        terminated = bool(fell or (self._slices >= lift_ends and not hangs))
        truncated = bool(ended and not terminated)
        if terminated or truncated:
            self._playing = None
        info = {
            **self._sample,
            "normal_force_n": float(rows["truth/normal_force_n"][-1]),
            "moved_mm": self._moved_mm,
            "lifted": self._lifted,
            "balanced": balanced,
        }
        return self._observation(), reward, terminated, truncated, info

    def _play(self, slices: int) -> dict[str, list[Any]]:
        """Simulate some slices, fewer if the scene ends, and return their rows of ground truth.

        Values for the observation are stored.
        """
        assert self._playing is not None
        rows: dict[str, list[Any]] = {name: [] for name in TRUTH}
        parts, near_dots, probability, slips = [], np.zeros(self._dots), 0.0, self._detector.count
        for entry in islice(self._playing, slices):
            parts.append(entry[0])
            for name in TRUTH:
                rows[name].append(entry[1][name])
            near_dots = near_dots + self._detector.tracking.events_per_dot
            probability = max(probability, float(np.nan_to_num(self._detector.probability)))
        self._slices += len(parts)
        self._events = concatenate(parts)
        each = 1.0 / len(parts)
        self._felt = (near_dots * each, probability, (self._detector.count - slips) * each)
        return rows

    def _object_now_mm(self, rows: dict[str, list[Any]]) -> NDArray[np.float64]:
        """Return the position of the object in the hand, in mm."""
        return np.asarray(rows["truth/object_xy_px"][-1], np.float64) * self._mm_per_px

    def _observation(self) -> Observation:
        tracking, reading = self._detector.tracking, self._gripper.read()
        events_per_dot, probability, slip_share = self._felt
        displacement_px = np.clip(tracking.dot_xy_px - tracking.rest_xy_px, -FARTHEST_PX, FARTHEST_PX)
        time_s = (self._slices - self._timing.touch_ms) * SLICE_US * 1e-6
        return {
            "displacement_px": displacement_px.astype(np.float32),
            "events_per_dot": np.minimum(events_per_dot, MOST_EVENTS).astype(np.float32),
            "slip": np.array([probability, slip_share], np.float32),
            "gripper": np.array([reading.position_ticks - self._touch_ticks, reading.current_ma], np.float32),
            "time_s": np.array([time_s], np.float32),
        }

    def render(self) -> NDArray[np.uint8] | None:
        """Return an image of the last step's events, (480, 640, 3): white for brighter, black for darker, else grey."""
        if self.render_mode is None:
            return None
        width, height = FRAME_PX
        picture = np.full((height, width, 3), 128, np.uint8)
        picture[self._events.y, self._events.x] = (255 * self._events.p)[:, None]
        return picture

    def close(self) -> None:
        """End the episode; further calls do nothing."""
        self._playing = None


def _varied(scene: Scene, mass_factor: tuple[float, float], hand_mm_s: float, lift_s: float) -> Scene:
    """Return the scene with other masses and hand speed; InputError if the hand would not be up by the lift's end."""
    low, high = mass_factor
    if not 0.01 <= low <= high <= 100.0:
        expected = "0.01 <= low <= high <= 100"
        raise InputError("not a range", where="mass_factor", expected=expected, found=f"{mass_factor}")
    if not 1.0 <= hand_mm_s <= 1000.0:
        raise InputError("out of range", where="hand_mm_s", expected="1 to 1000 mm/s", found=f"{hand_mm_s} mm/s")
    hand = scene.hand
    starts_mm_s2 = hand.acceleration_mm_s2 * (hand_mm_s / hand.speed_mm_s)  # same duration of the acceleration
    up_s = hand.height_mm / hand_mm_s + hand_mm_s / starts_mm_s2 + scene.time.before_rise_s
    if not up_s <= lift_s <= 600.0:
        expected = f"{up_s:.4g} s, the time that the hand takes to rise, to 600 s"
        raise InputError("out of range", where="lift_s", expected=expected, found=f"{lift_s} s")
    return replace(
        scene,
        randomise=replace(scene.randomise, mass=(float(low), float(high))),
        hand=replace(hand, speed_mm_s=float(hand_mm_s), acceleration_mm_s2=starts_mm_s2),
    )


gymnasium.register("evetac/Lift-v0", entry_point="evetac_cli.gym:LiftEnv")
