"""The trials of evetac-bench, from scripts/benchmark/recipe.toml: motion, object, sensor and seed of each."""

import itertools
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.errors import SceneError
from evetac_cli.sim.setup import object_file, scene_file
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.store.recordings import slip_grid
from evetac_cli.text_files import as_toml
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from evetac_cli.trials.trial import SimulatedTrial
from scripts.studies import motions
from scripts.studies.slip.recordings import trial_of

RECIPE = Path(__file__).with_name("recipe.toml")
KINDS = ("slip", "handling", "vibration", "press", "lift", "grip")
SPLIT_SEEDS, KIND_SEEDS = 300, 50
NEVER_S = 600.0  # the gripper does not let go
# Sensors and objects that are tried if a gel is too soft for an object, or the grid too coarse for the slip; with
# random sensors, the object is another one after SAME_OBJECT tries.
TRIES, SAME_OBJECT = 9, 3
SCENE_OBJECT = 8  # object whose row of the paper's table is replaced by a new object
PARAMETERS = 43  # with the seed of a trial: draws the recipe's parameters of that trial


@dataclass(frozen=True)
class Slot:
    """One trial of the benchmark: its place among those of its kind and split; name: in the files, without meaning."""

    name: str
    split: str
    kind: str
    place: int
    seed: int


def recipe() -> dict[str, Any]:
    """Return the recipe."""
    return tomllib.loads(RECIPE.read_text())


def slots(recipe: Mapping[str, Any], size: str) -> list[Slot]:
    """Return the trials of a size by their names; those of the small size are also in the full one."""
    splits = list(recipe["splits"])
    most = len(splits) * SPLIT_SEEDS
    names = np.random.default_rng(recipe["first_seed"]).permutation(most)
    found = []
    for (at, split), (number, kind) in itertools.product(enumerate(splits), enumerate(KINDS)):
        for place in range(recipe["sizes"][size][kind]):
            offset = SPLIT_SEEDS * at + KIND_SEEDS * number + place
            found.append(Slot(f"r{names[offset]:03d}", split, kind, place, recipe["first_seed"] + offset))
    return sorted(found, key=lambda slot: slot.name)


def candidates(recipe: Mapping[str, Any], slot: Slot) -> Iterator[tuple[str, int]]:
    """Yield sensors of a trial in order of preference, each with a shift in the list of objects."""
    known = recipe["splits"][slot.split]["sensor"]
    if known != "randomized":
        yield from ((known, shift) for shift in range(TRIES))
        return
    split = list(recipe["splits"]).index(slot.split)
    first = recipe["first_sensor"] + SPLIT_SEEDS * split + (slot.place + 2 * KINDS.index(slot.kind)) % recipe["sensors"]
    yield from ((f"randomized:{first + recipe['sensors'] * at}", at // SAME_OBJECT) for at in range(TRIES))


def object_of(recipe: Mapping[str, Any], slot: Slot, shift: int = 0) -> tuple[int, str, TouchedObject]:
    """Return the number of a row in the paper's table, the name, and the object of a trial."""
    at = slot.place + KINDS.index(slot.kind) + shift
    if recipe["splits"][slot.split]["objects"] == "known":
        number = recipe["known_objects"][at % len(recipe["known_objects"])]
        return number, f"paper-{number}", object_file.of_number(number)
    name = list(recipe["objects"])[at % len(recipe["objects"])]
    return SCENE_OBJECT, name, object_file.of_keys(recipe["objects"][name], str(RECIPE), object_file.HELD)


def face_of(recipe: Mapping[str, Any], slot: Slot) -> str:
    """Return the name of the face of a press."""
    if recipe["splits"][slot.split]["objects"] == "known":
        return "paper"
    new = [name for name in recipe["faces"] if name != "paper"]
    return new[slot.place % len(new)]


@dataclass(frozen=True)
class Made:
    """A trial that can be simulated, with the names of its sensor and object, which are truth."""

    trial: SimulatedTrial
    sensor: str
    object_name: str
    motion: str


def trial(recipe: Mapping[str, Any], slot: Slot, output: Path) -> Made:
    """Return the trial of a slot with the first sensor and object with which it can be played and resolved."""
    for sensor, shift in candidates(recipe, slot):
        if slot.kind == "press":
            made = _pressed(recipe, slot, sensor, output)
        else:
            made = _held(recipe, slot, sensor, output, shift)
        if _can_be_played(made.trial, must_resolve=slot.kind == "slip"):
            return made
    raise SystemExit(f"{slot}: expected a sensor and an object with which it can be played among {TRIES}, found none")


def _held(recipe: Mapping[str, Any], slot: Slot, sensor: str, output: Path, shift: int) -> Made:
    keys = recipe["kinds"][slot.kind]
    motion = keys["motions"][slot.place % len(keys["motions"])]
    number, object_name, object = object_of(recipe, slot, shift)
    rng = np.random.default_rng([PARAMETERS, slot.seed])
    planned = motions.planned(motion, number, slot.seed, sensor, object=object)
    scene = planned.plan.scene
    scene = replace(scene, gel=replace(scene.gel, cut=True))
    if slot.kind == "slip":
        scene = replace(scene, time=replace(scene.time, after_lost_s=float(rng.uniform(*keys["after_lost_s"]))))
    if "longest_s" in keys:
        scene = replace(scene, time=replace(scene.time, longest_s=float(rng.uniform(*keys["longest_s"]))))
    if slot.kind in ("handling", "vibration") and scene.gripper.current is None:
        scene = replace(scene, gripper=replace(scene.gripper, ramp_s=NEVER_S))
    planned = planned._replace(plan=replace(planned.plan, scene=scene))
    if slot.kind == "lift":
        planned = planned._replace(lift_s=keys["lift_s"], balance_s=keys["balance_s"])
    return Made(trial_of(planned, slot.seed, output), sensor, object_name, motion)


def _pressed(recipe: Mapping[str, Any], slot: Slot, sensor: str, output: Path) -> Made:
    keys, face = recipe["kinds"]["press"], face_of(recipe, slot)
    rng = np.random.default_rng([PARAMETERS, slot.seed])
    normal_n = float(rng.uniform(*keys["normal_n"]))
    motion = {"normal_n": normal_n, "shear_n": keys["shear_share"] * normal_n, "count": keys["count"]}
    motion |= {"pause_s": keys["pause_s"], "offset_mm": 5.0}
    size = {"size_mm": None, "radius_mm": None, **recipe["faces"][face]}
    path = output.with_suffix(".scene.toml")
    changes = {"name": "bench-press", "face": size, "motion": motion}
    path.write_text(scene_file.changed("shear", changes))
    (one,) = record.jobs([], Record(scene=str(path), sensor=sensor, seed=slot.seed), output)
    path.unlink()
    assert isinstance(one, SimulatedTrial)
    return Made(one, sensor, f"face-{face}", "shear")


def _can_be_played(one: SimulatedTrial, *, must_resolve: bool) -> bool:
    """Whether this trial can be simulated to its end, and its slip is resolved if it must be; without the camera."""
    try:
        devices, slices = motions.slices_of(
            motions.Planned(one.plan, *_lift_of(one)), 0, one.seed, motions.without_camera
        )
    except SceneError:
        return False
    try:
        nodes = [row["truth/slip_half_wavelength_nodes"] for _, row in slices]
    except SceneError:
        return False
    finally:
        devices.close()
    return not (must_resolve and slip_grid.is_unresolved(slip_grid.fewest_nodes(nodes)))


def _lift_of(one: SimulatedTrial) -> tuple[int, float, float]:
    """Return ticks, lift and balance of a recorded lift, for `motions.Planned`; zeros for other trials."""
    if not isinstance(one, SimulatedGrasp):
        return 0, 0.0, 0.0
    return int(one.settings.controller.partition(":")[2]), one.settings.lift_s, one.settings.balance_s


def lift_files(recipe: Mapping[str, Any], slot: Slot, folder: Path) -> tuple[dict[str, str], dict[str, Any], str]:
    """Return scene and object of a closed-loop lift as TOML, the flags of `evetac grasp` that play it, and the object.

    folder: where the files are written for a moment, to check whether the lift can be played.
    """
    keys = recipe["kinds"]["grip"]
    rng = np.random.default_rng([PARAMETERS, slot.seed])
    changes: dict[str, Any] = {
        "name": "bench-lift",
        "hand": {"speed_mm_s": round(float(rng.uniform(*keys["speed_mm_s"])), 1), "acceleration_mm_s2": 200.0},
    }
    if drop_g := float(rng.choice(keys["drop_g"])):
        changes["drop"] = {"mass_g": drop_g, "after_s": round(float(rng.uniform(0.5, 2.0)), 2), "speed_m_s": 0.5}
    scene = scene_file.changed("lift", changes)
    for sensor, shift in candidates(recipe, slot):
        _, object_name, object = object_of(recipe, slot, shift)
        row = {key: value for key, value in vars(object).items() if value is not None}
        texts = {"scene": scene, "object": as_toml({"name": object_name, **row})}
        flags = {"sensor": sensor, "seed": slot.seed, "lift_s": keys["lift_s"], "balance_s": keys["balance_s"]}
        if _can_be_lifted(texts, flags, folder):
            return texts, flags, object_name
    raise SystemExit(f"{slot}: expected a sensor on which it can be played among {TRIES}, found none")


def _can_be_lifted(texts: Mapping[str, str], flags: Mapping[str, Any], folder: Path) -> bool:
    paths = {name: folder / f"check.{name}.toml" for name in texts}
    for name, text in texts.items():
        paths[name].write_text(text)
    try:
        asked = Grasp(scene=str(paths["scene"]), objects=str(paths["object"]), controller="fixed:10", **flags)
        (one,) = grasp.jobs([], asked, folder / "check.recording.h5")
        assert isinstance(one, SimulatedTrial)
        return _can_be_played(one, must_resolve=False)
    finally:
        for path in paths.values():
            path.unlink()
