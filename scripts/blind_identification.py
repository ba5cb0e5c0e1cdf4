"""Blind identification: are sensors that identify has never seen found again, and is their twin told from them?

    python scripts/blind_identification.py WORK --first 20000 --count 20 --jobs 2

For each sensor randomized:N it simulates what docs/identify.md asks of an owner, shortened: a rest, strokes of a press
with a pause after each, and a gripper that closes, holds, and lets an object slip, at three places; runs `evetac
identify`; and compares the interval of each parameter in PARAMETERS with the truth. Then it simulates rest and press
again: by the sensor itself with another seed, and by its twin, the identified sensor, with a third. A classifier
(kernels/realism) tells the half seconds of the first recordings from those of the second, of either from the twin's,
and of the first from the next sensor's.

What is compared and how was committed before the first run on sensors from 20,000 on. A sensor that WORK holds already
is not made again, so that a run may be stopped and several may share the sensors; one that was cut off is made again.
The table is of all that WORK holds, with --camera-only or without, never both.
All figures are simulated.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from reproduce import commit

from evetac_cli.console import print_table
from evetac_cli.resources import SCENES
from evetac_cli.sim import gripper
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.camera.lens import Lens
from evetac_cli.sim.gripper import Drive
from evetac_cli.sim.setup import sensor_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.stages.evaluate import realism
from evetac_cli.store.read import open_recording

ROOT = Path(__file__).resolve().parents[1]
# The packaged scenes, with a longer rest, with fewer and faster strokes after each of which the gel comes to rest, and
# with objects that are touched farther from the middle of the gel.
REST = {"rest_s": 3.0}
PRESS = {"lines": 5, "speed_mm_s": 40.0, "approach_s": 0.8, "node_pitch_mm": 1.0}
GRIP, GRIPS = {"touch_mm": 3.0}, 3
SECOND_SEED, TWIN_SEED, GRIP_SEED = 1000, 2000, 3000  # beyond the seed of a sensor's first recordings, or grip before
OBJECT, OBJECT_G, OBJECT_FRICTION = 18, 550, 0.9  # what the gripper holds, a bottle of glass
OPEN_M = 0.060  # about which the fingers bend
QUARTER, HELD = 0.25, 0.9  # an interval so wide, in prior ranges, that holds the truth in so many cases, is told
AUC_ROOM, AUC_OTHER = 0.05, 0.9

Row = dict[str, Any]


@dataclass(frozen=True)
class Parameter:
    """A row of identify's table: its prior range, and the truth of a sensor."""

    name: str
    low: float
    high: float
    truth: Callable[[Sensor], float]
    part: str = "camera"


def _of_drive(value: Callable[[Drive], float]) -> Callable[[Sensor], float]:
    return lambda sensor: value(gripper.make_drive(sensor.gripper))


def _bending(sensor: Sensor) -> float:
    """How many ticks the fingers bend per mA."""
    stiffness_n_m = sensor.gripper.finger_stiffness_n_m
    assert stiffness_n_m is not None
    force_n_ma = gripper.make_drive(sensor.gripper).force_per_current_n_ma
    return force_n_ma / stiffness_n_m / gripper.metres_per_tick(OPEN_M)


def _held(sensor: Sensor) -> float:
    """Static friction of the held object times the force per current."""
    force_n_ma = gripper.make_drive(sensor.gripper).force_per_current_n_ma
    return OBJECT_FRICTION * sensor.static_friction_factor * force_n_ma


PLACES = "error of a dot's place, 95 %"
PARAMETERS = (
    Parameter("noise_hz", 0.015, 0.11, lambda sensor: sensor.noise_hz),
    Parameter(PLACES, 0.0, 12.0, lambda sensor: 0.0),  # of dots that are shifted by up to 6 px either way; see `places`
    Parameter("dot_radius_px", 12.5, 17.5, lambda sensor: sensor.dot_radius_px),
    Parameter("dot_radius_spread", 0.0, 0.06, lambda sensor: sensor.dot_radius_spread),
    Parameter("dot_contrast_spread", 0.0, 0.15, lambda sensor: sensor.dot_contrast_spread),
    Parameter("edge_sigma_px", 0.8, 1.8, lambda sensor: sensor.edge_sigma_px),
    Parameter("distortion", -0.05, 0.02, lambda sensor: sensor.distortion[0]),
    Parameter(
        "log_contrast / threshold", 1.3 / 0.35, 1.75 / 0.12, lambda sensor: sensor.log_contrast / sensor.threshold
    ),
    Parameter(
        "threshold_off / threshold",
        0.8,
        1.25,
        lambda sensor: (sensor.threshold_off or sensor.threshold) / sensor.threshold,
    ),
    Parameter("mismatch", 0.02, 0.08, lambda sensor: sensor.mismatch),
    Parameter(
        "gripper: gear friction", 4.79, 25.65, _of_drive(lambda d: d.friction_n / d.force_per_current_n_ma), "gripper"
    ),
    Parameter(
        "gripper: damping",
        0.2,
        0.833,
        _of_drive(lambda d: d.damping_n_s_m / d.force_per_current_n_ma / 1e3),
        "gripper",
    ),
    Parameter("gripper: moving mass", 1.0, 16.7, _of_drive(lambda d: d.mass_kg / d.force_per_current_n_ma), "gripper"),
    Parameter(
        "gripper: bending of the fingers",
        0.972,
        2.025,
        _bending,
        "gripper",
    ),
    Parameter("gripper.backlash_ticks", 0.0, 3.0, lambda sensor: sensor.gripper.backlash_ticks, "gripper"),
    Parameter("gripper.encoder_noise_ticks", 0.0, 0.7, lambda sensor: sensor.gripper.encoder_noise_ticks, "gripper"),
    Parameter("gripper.command_delay_ms", 1.0, 8.0, lambda sensor: sensor.gripper.command_delay_ms, "gripper"),
    Parameter("gripper.command_jitter_ms", 0.0, 4.0, lambda sensor: sensor.gripper.command_jitter_ms, "gripper"),
    Parameter("gripper: servo gain", 3.6, 10.0, _of_drive(lambda d: d.gain_ma_tick), "gripper"),
    Parameter("shear_modulus_pa", 70e3, 300e3, lambda sensor: sensor.shear_modulus_pa, "gel"),
    Parameter(
        "creep.share, both arms", 0.0, 0.2, lambda sensor: sum(sensor.creep.share) if sensor.creep else 0.0, "gel"
    ),
    Parameter(
        "static friction x force per current",
        0.216,
        0.54,
        _held,
        "friction",
    ),
    Parameter("bandwidth_hz", 300.0, 3000.0, lambda sensor: sensor.bandwidth_hz),
    Parameter("normal_modulus_pa", 0.5e6, 2.0e6, lambda sensor: sensor.normal_modulus_pa, "gel"),
    Parameter("loss_tangent", 0.06, 0.24, lambda sensor: sensor.loss_tangent or 0.0, "gel"),
    Parameter("gripper.force_per_current_n_ma", 0.3, 0.5, _of_drive(lambda d: d.force_per_current_n_ma), "gripper"),
)


def changed(name: str, values: Mapping[str, float]) -> str:
    """The text of a packaged scene with other values of some keys."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    for key, value in values.items():
        text, hits = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
        if hits != 1:
            raise ValueError(f"{name}.toml: expected one {key}, found {hits}")
    return text


def evetac(*words: object) -> Row:
    """Run a command of evetac and return what --json prints."""
    command = [sys.executable, "-P", "-m", "evetac_cli", *map(str, words), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[2:])}: exit {done.returncode}\n{done.stderr[-2000:]}")
    answer: Row = json.loads(done.stdout)
    return answer


def recordings(work: Path, folder: Path, sensor: str, seed: int, name: str) -> list[Path]:
    """A rest and a press by a sensor."""
    paths = []
    for kind in ("rest", "press"):
        path = folder / f"{name}-{kind}.recording.h5"
        by_sensor = ("--sensor", sensor, "--seed", seed)
        evetac("record", "--scene", work / f"{kind}.toml", *by_sensor, "--force", "-o", path)
        paths.append(path)
    return paths


def features(paths: list[Path]) -> NDArray[np.float64]:
    """Windows of recordings for the classifier."""
    parts = []
    for path in paths:
        with open_recording(path) as recording:
            parts.append(realism.window_features(recording))
    return np.concatenate(parts)


def places(sensor: Sensor, file: Path) -> NDArray[np.float64] | None:
    """How far dots of the identified sensor are from where the true one's are seen, in px; None without them."""
    _, twin = sensor_file.read(file, one_sensor)
    if not twin.dot_xy_px:
        return None
    seen = []
    for one in (twin, sensor):
        lens = Lens.of_sensor(one)
        dots = dot_grid(one, cut=False)
        seen.append(dots if lens is None else lens.seen(dots))
    return np.asarray(seen[0] - seen[1]) if seen[0].shape == seen[1].shape else None


def identify_one(work: Path, number: int, *, camera_only: bool, keep: bool) -> None:
    """All of one sensor, into WORK/NUMBER.json and WORK/NUMBER.npz."""
    if kept(work, number) is not None:
        return
    started = time.perf_counter()
    sensor, folder = f"randomized:{number}", work / str(number)
    folder.mkdir(exist_ok=True)
    true = one_sensor(sensor)
    first = recordings(work, folder, sensor, number, "first")
    known: list[object] = []
    grips: list[Path] = []
    if not camera_only:
        for place in range(GRIPS):
            grips.append(folder / f"grip-{place + 1}.recording.h5")
            gripped = ("--scene", work / "grip-steps.toml", "--object", OBJECT, "--sensor", sensor)
            evetac("record", *gripped, "--seed", number + place * GRIP_SEED, "--force", "-o", grips[-1])
        grips.append(folder / "grasp.recording.h5")
        moves = ("--controller", "fixed:6", "--lift-s", 2, "--balance-s", 0)
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
    unfinished = work / f"{number}.part.npz"
    np.savez(unfinished, first=windows["first"], second=windows["second"], twin=windows["twin"])
    unfinished.replace(work / f"{number}.npz")
    shutil.copy(twin, work / f"{number}.sensor.toml")
    if not keep:
        shutil.rmtree(folder)
    about = {
        "number": number,
        "camera_only": camera_only,
        "rows": answer["rows"],
        "truth": {one.name: one.truth(true) for one in PARAMETERS},
        "places_off_px": None if off_px is None else np.abs(off_px).ravel().tolist(),
        "seconds": time.perf_counter() - started,
    }
    unfinished = work / f"{number}.json.part"
    unfinished.write_text(json.dumps(about, indent=1))
    unfinished.replace(work / f"{number}.json")
    print(f"randomized:{number}: {about['seconds']:.0f} s", file=sys.stderr)


def kept(work: Path, number: int) -> tuple[Row, dict[str, NDArray[np.float64]]] | None:
    """What WORK holds of a sensor: its result and its windows; None where either is missing or cut off."""
    try:
        result: Row = json.loads((work / f"{number}.json").read_text())
        with (work / f"{number}.npz").open("rb") as file, np.load(file) as windows:
            return result, {name: windows[name] for name in ("first", "second", "twin")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def all_kept(work: Path, *, camera_only: bool) -> dict[int, tuple[Row, dict[str, NDArray[np.float64]]]]:
    """All sensors that WORK holds, by number; ValueError where some are with the gripper, and others without."""
    numbers = sorted(int(path.stem) for path in work.glob("*.json") if path.stem.isdigit())
    held = {number: one for number in numbers if (one := kept(work, number)) is not None}
    others = [str(number) for number, (result, _) in held.items() if result["camera_only"] != camera_only]
    if others:
        how = "with" if camera_only else "without"
        raise ValueError(
            f"{work} holds sensors that were made {how} the gripper: {', '.join(others)}; take another folder"
        )
    return held


def interval(result: Row, parameter: Parameter) -> tuple[float, bool] | None:
    """Width of a parameter's interval in prior ranges and whether it holds the truth; None where nothing is told."""
    row = next((row for row in result["rows"] if row["parameter"] == parameter.name), None)
    if row is None or row["estimate"] is None:
        return None
    size = parameter.high - parameter.low
    if parameter.name == PLACES:
        if result["places_off_px"] is None:
            return None
        half_px = row["estimate"]
        held = float(np.mean(np.array(result["places_off_px"]) <= half_px))
        return 2 * half_px / size, held >= HELD
    return (row["high"] - row["low"]) / size, bool(row["low"] <= result["truth"][parameter.name] <= row["high"])


def parameter_rows(results: list[Row]) -> list[Row]:
    """A row for every parameter: how often it is told, how wide, and how often the truth is held."""
    rows = []
    for parameter in PARAMETERS:
        intervals = [one for one in (interval(row, parameter) for row in results) if one is not None]
        width = float(np.mean([one[0] for one in intervals])) if intervals else None
        held = sum(one[1] for one in intervals)
        is_found = (
            width is not None and len(intervals) == len(results) and width <= QUARTER and held >= HELD * len(intervals)
        )
        rows.append(
            {
                "parameter": parameter.name,
                "part": parameter.part,
                "prior_low": parameter.low,
                "prior_high": parameter.high,
                "sensors": len(results),
                "told": len(intervals),
                "held": held if intervals else None,
                "width_mean": width,
                "width_worst": max(one[0] for one in intervals) if intervals else None,
                "found": is_found,
            }
        )
    return rows


def area_rows(windows: Mapping[int, Mapping[str, NDArray[np.float64]]]) -> list[Row]:
    """A row for every sensor: how well its windows are told from its own again, its twin's, and the next one's."""
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
                "sensor": f"randomized:{number}",
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
    """How many parameters are found, and the classifier's mean areas."""
    means: Row = {}
    for name in ("auc_same", "auc_twin", "auc_other"):
        known = [row[name] for row in areas if row[name] is not None]
        means[f"{name}_mean"] = float(np.mean(known)) if known else None
    return {
        "sensors": len(results),
        "parameters": len(parameters),
        "parameters_found": sum(row["found"] for row in parameters),
        "never_told": [row["parameter"] for row in parameters if row["told"] == 0],
        **means,
        "twins_like_the_sensor": sum(bool(row["twin_is_like"]) for row in areas),
        "others_told_apart": sum(bool(row["other_is_not"]) for row in areas),
        "seconds_a_sensor": float(np.mean([row["seconds"] for row in results])),
    }


def main() -> None:
    """Make what is not there yet, and print and write the table of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="folder of the recordings and of what is found")
    parser.add_argument("--first", type=int, required=True, help="number of the first sensor, as in randomized:N")
    parser.add_argument("--count", type=int, default=1, help="sensors")
    parser.add_argument("--jobs", type=int, default=1, help="sensors at once")
    parser.add_argument("--out", type=Path, default=None, help="JSON of the tables, as docs/results/NAME.json")
    parser.add_argument("--camera-only", action="store_true", help="neither gripper nor gel")
    parser.add_argument("--keep", action="store_true", help="keep the recordings, about 150 MB a sensor")
    asked = parser.parse_args()
    asked.work.mkdir(parents=True, exist_ok=True)
    for name, values in (("rest", REST), ("press", PRESS), ("grip-steps", GRIP)):
        (asked.work / f"{name}.toml").write_text(changed(name, values), encoding="utf-8")
    try:
        all_kept(asked.work, camera_only=asked.camera_only)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    numbers = range(asked.first, asked.first + asked.count)
    with ThreadPoolExecutor(asked.jobs) as pool:
        made = [
            pool.submit(identify_one, asked.work, one, camera_only=asked.camera_only, keep=asked.keep)
            for one in numbers
        ]
        for one in made:
            one.result()
    held = all_kept(asked.work, camera_only=asked.camera_only)
    results = [result for result, _ in held.values()]
    parameters = parameter_rows(results)
    areas = area_rows({number: windows for number, (_, windows) in held.items()})
    of_all = summary(results, parameters, areas)
    print_table("blind identification", parameters, {}, simulated=True)
    print_table("windows told apart", areas, of_all, simulated=True)
    if asked.out is not None:
        head, changes = commit()
        options = " --camera-only" if asked.camera_only else ""
        first, last = results[0]["number"], results[-1]["number"]
        command = f"python scripts/blind_identification.py WORK --first {first} --count {last - first + 1}{options}"
        about = {
            "name": asked.out.stem,
            "title": f"Parameters of sensors randomized:{first} to {last} in blind identification",
            "simulated": True,
            "made": time.strftime("%Y-%m-%d", time.gmtime()),
            "commit": head,
            "uncommitted_changes": changes,
            "commands": [command],
            "summary": of_all,
            "rows": parameters,
            "classifier": areas,
        }
        asked.out.write_text(json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    main()
