"""Blind identification: does `identify` recover unseen sensors, and can their twins be distinguished from them?

    make blind-identification                       # 20 sensors, starting at randomized-narrow:20020
    make blind-identification SIZES="first=20100 sensors=3 grips=0"

For each sensor randomized-narrow:N the script does four things:

- It simulates the recordings that docs/identify.md requires from an owner, shortened. These are a rest, strokes of a
  press with a pause after each, and a gripper that closes, holds, and lets an object slip, at three positions.
- It runs `evetac identify` and compares the interval of each parameter in PARAMETERS with the truth.
- It simulates rest and press again, by the sensor itself with another seed, and by its twin, the identified sensor,
  with a third seed.
- A classifier (kernels/realism.py) learns to distinguish half seconds of recordings: first from second, either from the
  twin's, and first from the next sensor's.

The comparison was fixed by a commit before the first run on sensors from 20,000. The script skips sensors whose results
are complete in the folder, so a run may be stopped and continued. The table covers all sensors in the folder, either
with grips or without, never both. All figures are simulated.
"""

import json
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product
from operator import attrgetter, getitem
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.console import print_table
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.evaluate.realism import measure as realism
from evetac_cli.jobs import Row
from evetac_cli.sim import gripper
from evetac_cli.sim.camera.gel_camera import Lens, dot_grid
from evetac_cli.sim.gripper import Drive
from evetac_cli.sim.setup import sensor_file
from evetac_cli.sim.setup.plan import one_sensor, sensor_ranges
from evetac_cli.sim.setup.sampling import sample_sensor
from evetac_cli.sim.setup.scene_file import changed, merged
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.store.recordings.read import open_recording
from scripts.reproduce.experiment import Check, Experiment, Figure, Study, measured
from scripts.reproduce.steps import Sizes
from scripts.reproduce.tables import Evaluation, Evaluations

RANGES = "randomized-narrow"  # the ranges of this sensor are the priors of the committed table
ROOT = Path(__file__).resolve().parents[3]
# The packaged scenes with a longer rest, with fewer and faster strokes, each followed by a pause until the gel is at
# rest, and with objects that touch farther from the middle of the gel.
SCENES: dict[str, dict[str, Any]] = {
    "rest": {"time": {"rest_s": 3.0}},
    "press": {
        "motion": {"lines": 5, "speed_mm_s": 40.0, "approach_s": 0.8},
        "solver": {"node_pitch_mm": 1.0},
    },
    "grip-steps": {"randomise": {"touch_mm": 3.0}},
}
SECOND_SEED, TWIN_SEED, GRIP_SEED = 1000, 2000, 3000  # seed offsets of later recordings, and between grips
OBJECT, OBJECT_G, OBJECT_FRICTION = 18, 550, 0.9  # the object in the gripper, a glass bottle
OPEN_M = 0.060  # the gap at which the bending of the fingers is evaluated
QUARTER, HELD = 0.25, 0.9  # identified: width in prior ranges at most, share with truth at least
AUC_ROOM, AUC_OTHER = 0.05, 0.9

Windows = dict[str, NDArray[np.float64]]


def ends_of(entry: Any) -> tuple[Any, Any]:
    """Return the lowest and the highest value of a sensors.toml entry: a range, a list of ranges, or one value."""
    if isinstance(entry, list):
        low, high = zip(*map(ends_of, entry), strict=True)
        return list(low), list(high)
    if isinstance(entry, Mapping):
        (low, high) = next(ends for name, ends in entry.items() if name != "stream")
        return low, high
    return entry, entry


@dataclass(frozen=True)
class Parameter:
    """A row of identify's table: the true value of a sensor, and the entries of RANGES from which its prior follows."""

    name: str
    part: str = "camera"
    of_sensor: Callable[[Sensor], float] | None = None  # default: the sensor's attribute of this name
    ranges: tuple[str, ...] = ()  # default: the entry of this name

    def truth(self, sensor: Sensor) -> float:
        """Return the true value for a sensor."""
        return (self.of_sensor or attrgetter(self.name))(sensor)

    @cached_property
    def prior(self) -> tuple[float, float]:
        """Return the lowest and the highest value over the ends of its ranges."""
        keys = self.ranges or (self.name,)
        values = []
        for corner in product(*(ends_of(reduce(getitem, key.split("."), sensor_ranges(RANGES))) for key in keys)):
            row: Mapping[str, Any] = sensor_ranges(RANGES)
            for key, value in zip(keys, corner, strict=True):
                row = merged(row, reduce(lambda inner, name: {name: inner}, reversed(key.split(".")), value))
            values.append(self.truth(sample_sensor(row, np.random.default_rng(0))))
        return min(values), max(values)


def _drive(sensor: Sensor) -> Drive:
    return gripper.make_drive(sensor.gripper)


def _over_n_ma(name: str, unit: float = 1.0) -> Callable[[Sensor], float]:
    """Return a constant of the drive divided by its force per current."""
    return lambda sensor: unit * getattr(_drive(sensor), name) / _drive(sensor).force_per_current_n_ma


def _rubs(sensor: Sensor) -> float:
    """Return the gear's kinetic friction divided by its force per current; static friction is not identified."""
    drive = _drive(sensor)
    return drive.kinetic_share * drive.friction_n / drive.force_per_current_n_ma


def _contrast(sensor: Sensor) -> float:
    return sensor.log_contrast / sensor.threshold


def _off_over_on(sensor: Sensor) -> float:
    return (sensor.threshold_off or sensor.threshold) / sensor.threshold


def _creep(sensor: Sensor) -> float:
    return sum(sensor.creep.share) if sensor.creep else 0.0


def _held(sensor: Sensor) -> float:
    """Return the static friction of the held object times the force per current."""
    return OBJECT_FRICTION * sensor.static_friction_factor * _drive(sensor).force_per_current_n_ma


def _shift_px(sensor: Sensor) -> float:
    """Return the distance of the dot columns from the start of their range."""
    ranges = sensor_ranges(RANGES)
    least_px, _ = ends_of(ranges["dot_shift_x_px"])
    return float(sensor.dot_columns_px[0] - ranges["dot_columns_px"][0] - least_px)


def _bending(sensor: Sensor) -> float:
    """Return how many ticks the fingers bend per mA."""
    stiffness_n_m = sensor.gripper.finger_stiffness_n_m
    assert stiffness_n_m is not None
    return _drive(sensor).force_per_current_n_ma / stiffness_n_m / gripper.metres_per_tick(OPEN_M)


PLACES = "error of a dot's place, 95 %"  # see `places`; its range is that of the shift of all dots
N_MA, SERVO = "gripper.force_per_current_n_ma", "gripper.servo_n_tick"
FRICTION = ("gripper.two_ticks_n", "gripper.friction_factor")
PARAMETERS = (
    Parameter("noise_hz"),
    Parameter(PLACES, "camera", _shift_px, ("dot_shift_x_px",)),
    Parameter("dot_radius_px"),
    Parameter("dot_radius_spread"),
    Parameter("dot_contrast_spread"),
    Parameter("edge_sigma_px"),
    Parameter("distortion", of_sensor=lambda sensor: sensor.distortion[0]),
    Parameter("log_contrast / threshold", "camera", _contrast, ("log_contrast", "threshold")),
    Parameter("threshold_off / threshold", "camera", _off_over_on, ("threshold_off_factor",)),
    Parameter("mismatch"),
    Parameter("gripper: gear friction", "gripper", _rubs, (N_MA, SERVO, *FRICTION)),
    Parameter("gripper: damping", "gripper", _over_n_ma("damping_n_s_m", 1e-3), (N_MA, "gripper.damping_n_s_m")),
    Parameter("gripper: moving mass", "gripper", _over_n_ma("mass_kg"), (N_MA, "gripper.mass_kg")),
    Parameter("gripper: bending of the fingers", "gripper", _bending, (N_MA, "gripper.finger_stiffness_n_m")),
    Parameter("gripper.backlash_ticks", "gripper"),
    Parameter("gripper.encoder_noise_ticks", "gripper"),
    Parameter("gripper.command_delay_ms", "gripper"),
    Parameter("gripper.command_jitter_ms", "gripper"),
    Parameter("gripper: servo gain", "gripper", lambda sensor: _drive(sensor).gain_ma_tick, (N_MA, SERVO)),
    Parameter("shear_modulus_pa", "gel"),
    Parameter("creep.share, both arms", "gel", _creep, ("creep.share",)),
    Parameter("static friction x force per current", "friction", _held, (N_MA, "static_friction_factor")),
    Parameter("bandwidth_hz"),
    Parameter("normal_modulus_pa", "gel"),
    Parameter("loss_tangent", "gel"),
    Parameter(N_MA, "gripper"),
)


def evetac(*words: object) -> Row:
    """Run a command of evetac and return the output of --json."""
    command = [sys.executable, "-P", "-m", "evetac_cli", *map(str, words), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode:
        raise EvetacError(f"{' '.join(command[2:])}: exit {done.returncode}\n{done.stderr[-2000:]}")
    answer: Row = json.loads(done.stdout)
    return answer


def recordings(work: Path, folder: Path, sensor: str, seed: int, name: str) -> list[Path]:
    """Record a rest and a press by a sensor."""
    paths = []
    for kind in ("rest", "press"):
        path = folder / f"{name}-{kind}.recording.h5"
        by_sensor = ("--sensor", sensor, "--seed", seed)
        evetac("record", "--scene", work / f"{kind}.toml", *by_sensor, "--force", "-o", path)
        paths.append(path)
    return paths


def features(paths: list[Path]) -> NDArray[np.float64]:
    """Return the windows of recordings for the classifier."""
    parts = []
    for path in paths:
        with open_recording(path) as recording:
            parts.append(realism.window_features(recording))
    return np.concatenate(parts)


def places(sensor: Sensor, file: Path) -> NDArray[np.float64] | None:
    """Return the distances of the identified sensor's dots from the true ones, in px; None without dots."""
    _, twin = sensor_file.read(file, one_sensor)
    if not twin.dot_xy_px:
        return None
    seen = []
    for one in (twin, sensor):
        lens = Lens.of_sensor(one)
        dots = dot_grid(one, cut=False)
        seen.append(dots if lens is None else lens.seen(dots))
    return np.asarray(seen[0] - seen[1]) if seen[0].shape == seen[1].shape else None


def identify_one(work: Path, number: int, grip_count: int) -> None:
    """Process one sensor; write WORK/NUMBER.json and WORK/NUMBER.npz."""
    if kept(work, number) is not None:
        return
    started = time.perf_counter()
    sensor, folder = f"{RANGES}:{number}", work / str(number)
    folder.mkdir(exist_ok=True)
    true = one_sensor(sensor)
    first = recordings(work, folder, sensor, number, "first")
    known: list[object] = []
    grips: list[Path] = []
    if grip_count:
        for place in range(grip_count):
            grips.append(folder / f"grip-{place + 1}.recording.h5")
            gripped = ("--scene", work / "grip-steps.toml", "--object", OBJECT, "--sensor", sensor)
            evetac("record", *gripped, "--seed", number + place * GRIP_SEED, "--force", "-o", grips[-1])
        grips.append(folder / "grasp.recording.h5")
        moves = ("--controller", "fixed:6", "--lift-s", 2, "--balance-s", 0, "--node-pitch-mm", 1.45)
        evetac("grasp", *moves, "--sensor", sensor, "--seed", number, "--force", "-o", grips[-1])
        known = ["--object-mass-g", OBJECT_G, "--pixel-mm", round(true.mm_per_px, 4)]
    twin = folder / "twin.sensor.toml"
    answer = evetac("identify", *first, *grips, *known, "--name", f"twin-{number}", "--force", "-o", twin)
    off_px = places(true, twin)
    windows = {
        "first": features(first),
        "second": features(recordings(work, folder, sensor, number + SECOND_SEED, "second")),
        "twin": features(recordings(work, folder, str(twin), number + TWIN_SEED, "twin")),
    }
    np.savez(work / f"{number}.npz", first=windows["first"], second=windows["second"], twin=windows["twin"])
    shutil.copy(twin, work / f"{number}.sensor.toml")
    shutil.rmtree(folder)  # about 150 MB
    about = {
        "number": number,
        "camera_only": not grip_count,
        "rows": answer["rows"],
        "truth": {one.name: one.truth(true) for one in PARAMETERS},
        "places_off_px": None if off_px is None else np.abs(off_px).ravel().tolist(),
        "seconds": time.perf_counter() - started,
    }
    (work / f"{number}.json").write_text(json.dumps(about, indent=1))
    print(f"{RANGES}:{number}: {about['seconds']:.0f} s", file=sys.stderr)


def kept(work: Path, number: int) -> tuple[Row, Windows] | None:
    """Return a sensor's result and windows from WORK; None if either is missing or incomplete."""
    try:
        result: Row = json.loads((work / f"{number}.json").read_text())
        with (work / f"{number}.npz").open("rb") as file, np.load(file) as windows:
            return result, {name: windows[name] for name in ("first", "second", "twin")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def all_kept(work: Path, *, camera_only: bool) -> dict[int, tuple[Row, Windows]]:
    """Return all sensors in WORK by number; InputError if only some of them have grips."""
    numbers = sorted(int(path.stem) for path in work.glob("*.json") if path.stem.isdigit())
    held = {number: one for number in numbers if (one := kept(work, number)) is not None}
    others = [str(number) for number, (result, _) in held.items() if result["camera_only"] != camera_only]
    if others:
        how = "with" if camera_only else "without"
        raise InputError(
            f"there are sensors that were made {how} the gripper: {', '.join(others)}",
            where=str(work),
            hint="use another folder with --out",
        )
    return held


def interval(result: Row, parameter: Parameter) -> tuple[float, bool] | None:
    """Return an interval's width in prior ranges and whether it contains the truth; None if not identified."""
    row = next((row for row in result["rows"] if row["parameter"] == parameter.name), None)
    if row is None or row["estimate"] is None:
        return None
    low, high = parameter.prior
    if parameter.name == PLACES:
        if result["places_off_px"] is None:
            return None
        half_px = row["estimate"]
        held = float(np.mean(np.array(result["places_off_px"]) <= half_px))
        return 2 * half_px / (high - low), held >= HELD
    return (row["high"] - row["low"]) / (high - low), bool(row["low"] <= result["truth"][parameter.name] <= row["high"])


def parameter_rows(results: list[Row]) -> list[Row]:
    """Return a row for every parameter: how often it is identified, its width, and how often it contains the truth."""
    rows = []
    for parameter in PARAMETERS:
        intervals = [one for one in (interval(row, parameter) for row in results) if one is not None]
        width = float(np.mean([one[0] for one in intervals])) if intervals else None
        held = sum(one[1] for one in intervals)
        is_found = (
            width is not None and len(intervals) == len(results) and width <= QUARTER and held >= HELD * len(intervals)
        )
        low, high = parameter.prior
        row = {"parameter": parameter.name, "part": parameter.part, "prior_low": low, "prior_high": high}
        row |= {"sensors": len(results), "estimated": len(intervals), "held": held if intervals else None}
        worst = max(one[0] for one in intervals) if intervals else None
        rows.append({**row, "width_mean": width, "width_worst": worst, "found": is_found})
    return rows


def area_rows(windows: Mapping[int, Windows]) -> list[Row]:
    """Return a row for every sensor: the classifier's areas for its repeats, its twin and the next sensor."""
    numbers = list(windows)
    rows = []
    for place, number in enumerate(numbers):
        own, other = windows[number], windows[numbers[(place + 1) % len(numbers)]]
        same = realism.auc(own["first"], own["second"])
        of_twin = [realism.auc(own[name], own["twin"]) for name in ("first", "second")]
        twin = None if None in of_twin else float(np.mean([one for one in of_twin if one is not None]))
        apart = realism.auc(own["first"], other["first"]) if len(numbers) > 1 else None
        rows.append(
            {
                "sensor": f"{RANGES}:{number}",
                "windows": len(own["first"]),
                "auc_same": same,
                "auc_twin": twin,
                "auc_other": apart,
                "twin_is_like": None if same is None or twin is None else twin <= same + AUC_ROOM,
                "other_is_not": None if apart is None else apart >= AUC_OTHER,
            }
        )
    return rows


def summary(results: list[Row], parameters: list[Row], areas: list[Row]) -> Row:
    """Return how many parameters are identified, and the classifier's mean areas."""
    means: Row = {}
    for name in ("auc_same", "auc_twin", "auc_other"):
        known = [row[name] for row in areas if row[name] is not None]
        means[f"{name}_mean"] = float(np.mean(known)) if known else None
    return {
        "sensors": len(results),
        "parameters": len(parameters),
        "parameters_found": sum(row["found"] for row in parameters),
        "never_estimated": [row["parameter"] for row in parameters if row["estimated"] == 0],
        **means,
        "twins_like_the_sensor": sum(bool(row["twin_is_like"]) for row in areas),
        "others_distinguished": sum(bool(row["other_is_not"]) for row in areas),
        "seconds_a_sensor": float(np.mean([row["seconds"] for row in results])),
    }


def measure(sizes: Sizes, folder: Path, jobs: int) -> Evaluations:
    """Process the missing sensors, several at once; return all sensors' parameters and classifier results."""
    work, camera_only = folder.resolve(), not sizes["grips"]
    for name, changes in SCENES.items():
        (work / f"{name}.toml").write_text(changed(name, changes))
    all_kept(work, camera_only=camera_only)
    numbers = range(sizes["first"], sizes["first"] + sizes["sensors"])
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(lambda number: identify_one(work, number, sizes["grips"]), numbers))
    held = all_kept(work, camera_only=camera_only)
    results = [result for result, _ in held.values()]
    parameters = parameter_rows(results)
    areas = area_rows({number: windows for number, (_, windows) in held.items()})
    of_all = summary(results, parameters, areas)
    print_table("windows told apart", areas, of_all, simulated=True)
    about = {"sizes": {"trials": len(held), "first": min(held), "last": max(held)}, "classifier": areas}
    return {"blind-identification": Evaluation(parameters, of_all, simulated=True, about=about)}


BLIND_IDENTIFICATION = measured(
    "blind-identification",
    "Parameters of sensors randomized-narrow:{first} to {last} in blind identification",
    ("parameter", "{parameter}"),
    ("estimated", "{estimated} of {sensors}"),
    ("95 % interval contained the true value", "{held}"),
    ("width over the range of `randomized-narrow`, mean", "{width_mean:.2f}"),
    ("worst", "{width_worst:.2f}"),
    ("identifiable", "{found}"),
    notes=("Parameters that were estimated for no sensor cannot be identified.",),
)
STUDY = Study(
    experiments=(
        Experiment(
            "blind-identification", "does identify recover unseen sensors", "data/blind-identification",
            0.8, full={"first": 20_020, "sensors": 20, "grips": 3}, small={"sensors": 1},
            measure=measure,
            tables=(BLIND_IDENTIFICATION,),
        ),
    ),
    checks={
        "blind-identification": Check(("parameter",), (Figure("estimated", "sensors"), Figure("held", "estimated"))),
    },
    check_sizes={"blind-identification": {"sensors": 2}},
)  # fmt: skip
