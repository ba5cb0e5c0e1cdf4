"""Run grasps of randomised objects by a grip law, in memory: losses, and force relative to the force that just holds.

    python scripts/studies/grip/trials.py --law load-proportional --seeds 0-99 --rows rows/grip --jobs 2
    python scripts/studies/grip/trials.py --law paper fixed:40 oracle --seeds 0-99 --rows rows/grip
    python scripts/studies/grip/trials.py --table --rows rows/grip

Law and seed determine a grasp. A seed draws:

- the object: 30 to 600 g, friction 0.3 to 1.2, shape, width, centre of mass up to 20 mm away from the fingers;
- its sensor: evetac, or the randomized sensor of the seed's number;
- the friction of the gear, times 0.7 to 1.3, and a delay of 0 to 6 ms from detector to controller;
- a disturbance: none, a weight that falls on the object, a knock against the arm, or a hand that lifts fast.

Camera, tracker, detector and law are those of `grasp`, with 1.5 s of contact, 6 s of lift and 10 s of balance. Laws
without a detector run without the camera, which changes nothing for them. Rows are JSON lines in FOLDER/LAW.jsonl,
written as grasps end; existing ones are not run again. All results are simulated.

`oracle` and `oracle:1.5` have the true mass, friction and force on the object at every step (oracle.py).
"""

import argparse
import json
import math
import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices import Rig
from evetac_cli.devices.simulated import SimulatedGripper, rig
from evetac_cli.evaluate.grasp.measure import firmness
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels.grip.control import Control, uses_detector
from evetac_cli.resources import SHIPPED
from evetac_cli.sim import grasp_outcome
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.setup.held import FallingWeight, HandJerk
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.parts import untimed
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials.grasp.loop import grasp_slices
from evetac_cli.trials.grasp.settings import GraspSettings
from evetac_cli.trials.trial import SimulatedTrial
from scripts.studies.grip import oracle as grip_oracle
from scripts.studies.motions import without_camera
from scripts.studies.rows import add_rows, rows_in, seeds_of

LIFT_S, BALANCE_S = 6.0, 10.0
MASS_G, FRICTION, WIDTH_MM, HEIGHT_MM = (30.0, 600.0), (0.3, 1.2), (10.0, 95.0), (60.0, 200.0)
LEVER_MM = 20.0
# The most that a gripper should need: the strongest grip of the RH-P12-RN(A), at the motor current limit set by the
# paper's authors, is several times as large. If a centre of mass requires more, it is drawn again.
MOST_HOLDING_N = 20.0
GEAR, LATENCY_MS = (0.7, 1.3), 6
DISTURBANCES = ("none", "weight", "knock", "hand")
CALLED = "drawn"
STREAM = 41  # combined with the seed of a grasp to draw it
SHAPES: tuple[Literal["flat", "cylinder", "sphere"], ...] = ("flat", "cylinder", "sphere")


@dataclass(frozen=True)
class Drawn:
    """The properties of a grasp that its seed determines; the law is not among them."""

    seed: int
    plan: Plan
    latency_ms: int
    disturbance: str

    def rig(self, *, camera: bool) -> Rig:
        """Return its devices; without a camera, slices are empty."""
        one = SimulatedTrial((), Path(), 0, self.seed, self.plan)
        timer = untimed if camera else without_camera
        return rig(self.plan, one.seeds(), timer, lift_s=LIFT_S, balance_s=BALANCE_S)


def drawn(seed: int) -> Drawn:
    """Return the grasp of a seed."""
    rng = np.random.default_rng([STREAM, seed])
    of_lever, of_disturbance = rng.spawn(2)
    mass_g = float(np.exp(rng.uniform(*np.log(MASS_G))))
    friction = float(rng.uniform(*FRICTION))
    object = TouchedObject(
        shape=SHAPES[int(rng.integers(len(SHAPES)))],
        static_friction=friction,
        mass_g=mass_g,
        width_mm=float(np.exp(rng.uniform(*np.log(WIDTH_MM)))),
        height_mm=float(rng.uniform(*HEIGHT_MM)),
    )
    plan = first_plan("lift", "11", "evetac" if rng.random() < 0.5 else f"randomized:{seed}")
    # the friction between the object and this gel
    object = replace(object, static_friction=friction / plan.sensor.static_friction_factor)
    scene = plan.scene
    gear, latency_ms = float(rng.uniform(*GEAR)), int(rng.integers(LATENCY_MS + 1))
    varied = replace(scene.randomise, static_friction=(1.0, 1.0), mass=(1.0, 1.0), lever_mm=0.0)
    scene = replace(scene, gripper=replace(scene.gripper, friction_factor=(gear, gear)), randomise=varied)
    disturbance = DISTURBANCES[int(rng.integers(len(DISTURBANCES)))]
    scene = _disturbed(scene, disturbance, mass_g, of_disturbance)
    plan = replace(plan, scene=scene, object_name=CALLED)
    while True:
        lever_mm = float(of_lever.uniform(-LEVER_MM, LEVER_MM))
        one = Drawn(seed, replace(plan, object=replace(object, lever_mm=lever_mm)), latency_ms, disturbance)
        if _simulation(one.rig(camera=False)).holding_n <= MOST_HOLDING_N:
            return one


def _disturbed(scene: Any, disturbance: str, mass_g: float, rng: np.random.Generator) -> Any:
    """Return the scene with its disturbance of the object."""
    if disturbance == "weight":
        drop = FallingWeight(
            mass_g=mass_g * float(rng.uniform(0.1, 0.5)),
            after_s=float(rng.uniform(1.0, 6.0)),
            speed_m_s=float(rng.uniform(0.0, 0.5)),
        )
        return replace(scene, drop=drop)
    if disturbance == "knock":
        jerk = HandJerk(
            at_s=float(rng.uniform(4.0, 15.0)),
            speed_mm_s=float(rng.uniform(10.0, 80.0)) * float(rng.choice([-1.0, 1.0])),
            lasts_s=float(np.exp(rng.uniform(math.log(0.05), math.log(0.3)))),
        )
        return replace(scene, hand=replace(scene.hand, jerk=jerk))
    if disturbance == "hand":
        hand = replace(
            scene.hand,
            speed_mm_s=float(rng.uniform(40.0, 150.0)),
            acceleration_mm_s2=float(np.exp(rng.uniform(math.log(300.0), math.log(3000.0)))),
        )
        return replace(scene, hand=hand)
    return scene


def _simulation(devices: Rig) -> GraspSimulation:
    assert isinstance(devices.gripper, SimulatedGripper)
    return devices.gripper.simulation


@dataclass(frozen=True)
class Options:
    """Settings of the law and its detector that replace the defaults of `grasp`; None: the default."""

    margin: float | None = None
    model: Path | None = None
    slip_threshold: float | None = None
    false_alarms_per_min: float | None = None

    def flags(self) -> dict[str, Any]:
        """Return the settings as flags of `Grasp`."""
        named = {"grip_margin": self.margin, "model": self.model, "slip_threshold": self.slip_threshold}
        named["false_alarms_per_min"] = self.false_alarms_per_min
        return {name: value for name, value in named.items() if value is not None}

    def row(self) -> Row:
        """Return the settings as entries of a row, the model by its file name."""
        model = None if self.model is None else self.model.name
        return {**asdict(self), "model": model}

    def file_name(self, law: str) -> str:
        """Return the file for the rows of a law."""
        named = {name.replace("_", "-"): value for name, value in self.row().items() if value is not None}
        words = [f"{name}-{value if isinstance(value, str) else format(value, 'g')}" for name, value in named.items()]
        return "-".join([law.replace(":", "-"), *words]) + ".jsonl"


AS_SHIPPED = Options()


@lru_cache  # reading a model file takes 1/20 of the time of a grasp
def settings_of(law: str, latency_ms: int, options: Options) -> GraspSettings:
    """Return law, detector and timing for the flags of `grasp`; for an oracle, without the law."""
    named = "none" if law.startswith(grip_oracle.NAME) else law
    flags = {"model": Path(SHIPPED), "lift_s": LIFT_S, "balance_s": BALANCE_S} | options.flags()
    return GraspSettings.of(Grasp(controller=named, latency_ms=latency_ms, **flags))


def play(law: str, seed: int, options: Options = AS_SHIPPED) -> tuple[dict[str, Any], Row]:
    """Run a grasp; return its datasets by their paths in a recording, without events, and its outcome."""
    one = drawn(seed)
    settings = settings_of(law, one.latency_ms, options)
    timing = settings.timing(one.plan.scene.time.touch_s)
    camera = uses_detector(settings.law)
    devices = one.rig(camera=camera)
    buffer = TrialBuffer()
    try:
        simulation = _simulation(devices)
        detector = None if settings.detector is None else settings.detector.open(devices.camera.sensor)
        control = settings.control()
        if law.startswith(grip_oracle.NAME):
            control = Control(grip_oracle.of_name(law, simulation), timing.control_hz, law)
        for _, rows in grasp_slices(devices, detector, control, timing):
            buffer.append_rows(rows)
    finally:
        devices.close()
    arrays = buffer.row_arrays()
    sensor = one.plan.sensor
    figures = grasp_outcome.outcome(arrays, sensor.mm_per_px, timing.end_ms, sensor.gripper.force_per_current_n_ma)
    object = one.plan.object
    assert object is not None
    return arrays, {
        "law": law,
        "seed": seed,
        **options.row(),
        "threshold": None if settings.detector is None else settings.detector.threshold,
        "sensor": one.plan.sensor_name,
        "shape": object.shape,
        "mass_g": object.mass_g,
        "friction": simulation.sampled.static_friction,
        "width_mm": object.width_mm,
        "lever_mm": object.lever_mm,
        "carried_g": simulation.pads.carried_kg * 1e3,
        "gear_friction": simulation.sampled.gear_friction_factor,
        "latency_ms": one.latency_ms,
        "disturbance": one.disturbance,
        **figures,
    }


def _of_one(one: tuple[str, int, Options]) -> Row:
    return play(*one)[1]


def played(law: str, seeds: Sequence[int], folder: Path, jobs: int, options: Options = AS_SHIPPED) -> Rows:
    """Return the rows of some grasps by a law; missing ones are run first and added to its file."""
    path = folder / options.file_name(law)
    there = {row["seed"] for row in rows_in(path)}
    missing = [(law, seed, options) for seed in seeds if seed not in there]
    for row in _each(missing, jobs):
        add_rows(path, [row])
        sys.stderr.write(f"{law} {row['seed']}: {row['failure'] or 'kept'}\n")
    return [row for row in rows_in(path) if row["seed"] in set(seeds)]


def _each(grasps: Sequence[tuple[str, int, Options]], jobs: int) -> Iterator[Row]:
    if jobs == 1 or len(grasps) < 2:
        yield from map(_of_one, grasps)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(_of_one, grasps)


def main() -> None:
    """Run the missing grasps, and print a table of all rows in the folder for these seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--law", nargs="+", default=[], help="laws of --controller, or oracle[:MARGIN]")
    parser.add_argument("--seeds", type=seeds_of, default="0-99", help="FIRST-LAST")
    parser.add_argument("--rows", type=Path, required=True, help="folder of the rows")
    parser.add_argument("--grip-margin", type=float, help="margin of load-proportional, if not its default")
    parser.add_argument("--model", type=Path, help="detector, if not the pretrained one")
    parser.add_argument("--slip-threshold", type=float, help="as for grasp")
    parser.add_argument("--false-alarms-per-min", type=float, help="as for grasp")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--table", action="store_true", help="instead of --law: print a table of all laws in the folder"
    )
    chosen = parser.parse_args()
    if bool(chosen.law) == chosen.table:
        parser.error("expected --law or --table; name one of them")
    if chosen.grip_margin is not None and chosen.law != ["load-proportional"]:
        parser.error("--grip-margin needs --law load-proportional, and no other law")
    seeds = chosen.seeds
    options = Options(chosen.grip_margin, chosen.model, chosen.slip_threshold, chosen.false_alarms_per_min)
    rows = [row for law in chosen.law for row in played(law, seeds, chosen.rows, chosen.jobs, options)]
    if chosen.table:
        rows = [row for path in sorted(chosen.rows.glob("*.jsonl")) for row in rows_in(path) if row["seed"] in seeds]
    for row in summary(rows):
        sys.stdout.write(json.dumps(row) + "\n")


def summary(rows: Rows) -> Rows:
    """Return a row for each law and its settings."""
    names = ("law", *(item.name for item in fields(Options)))
    groups: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(name) for name in names), []).append(row)
    return [dict(zip(names, key, strict=True)) | firmness(group) for key, group in groups.items()]


if __name__ == "__main__":
    main()
