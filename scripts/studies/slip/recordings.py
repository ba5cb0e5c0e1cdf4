"""Record the motions for training slip detectors and for choosing among them, in the format of `record` and `grasp`.

`python scripts/studies/slip/recordings.py learn --out FOLDER` writes recordings of TRAINED objects into FOLDER/MOTION,
`choose` those of CHOSEN_BY objects. Every second recording is of a randomised sensor. Existing recordings are not made
again. Seeds: scripts/reproduce/seeds.json, group `slip detectors trained on motions`. `make ship` runs this first.
"""

import argparse
import multiprocessing
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import SceneError
from evetac_cli.jobs import silent
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.settings import GraspSettings, SimulatedGrasp
from evetac_cli.trials.trial import SimulatedTrial
from scripts.reproduce.experiment import Experiment, Study
from scripts.reproduce.steps import Command, Sizes, evetac, script
from scripts.studies import motions
from scripts.studies.motions import Planned
from scripts.studies.slip.trials import planned_at

FIRST_SEEDS = {"learn": 5000, "choose": 5600}
OBJECTS = {"learn": motions.TRAINED, "choose": motions.CHOSEN_BY}
# Trials. Fast jerks, weights and the data-rate scene are reserved for evaluation.
COUNTS = {
    "learn": {
        **{"slip": 49, "slip-varied": 89, "slip-speeds": 216, "handling": 69, "pushes": 98, "grip": 40, "jerks": 49},
        **{"lifting": 20, "opening": 59, "light touch": 11, "vibration": 22, "weak lifts": 30},
    },
    "choose": {
        **{"slip": 18, "slip-varied": 18, "slip-speeds": 72, "handling": 12, "pushes": 18, "grip": 9, "jerks": 6},
        **{"lifting": 3, "opening": 9, "light touch": 3, "vibration": 6, "weak lifts": 6},
    },
}
MOST = max(count for counts in COUNTS.values() for count in counts.values())
SENSORS_APART = 30  # numbers of the first random sensors of two motions; within a motion, no two trials share one


def trial_of(planned: Planned, seed: int, output: Path) -> SimulatedTrial:
    """Return the trial of a plan as a job of `record`, or of `grasp` if something is lifted."""
    named = ((), output, 0, seed, planned.plan)
    if planned.plan.scene.kind != "lift":
        return SimulatedTrial(*named)
    law = f"fixed:{planned.beyond_ticks}"
    settings = GraspSettings.of(Grasp(controller=law, lift_s=planned.lift_s, balance_s=planned.balance_s))
    return SimulatedGrasp(*named, settings, settings.timing(planned.plan.scene.time.touch_s))


class Slot(NamedTuple):
    """One recording; place is its number within the motion."""

    role: str
    motion: str
    place: int
    several: int
    folder: Path


def every_one(role: str, names: list[str], per_object: int, out: Path) -> Iterator[Slot]:
    """Return the recordings of a role, for these motions or, if none is given, all; per_object limits their number."""
    for motion, count in COUNTS[role].items():
        several = min(count, per_object * len(OBJECTS[role]))
        if not names or motion in names:
            yield from (Slot(role, motion, place, several, out / motion.replace(" ", "-")) for place in range(several))


def make(slot: Slot) -> str:
    """Make a recording; return the reason if it is left out, otherwise ""."""
    objects, first = OBJECTS[slot.role], FIRST_SEEDS[slot.role]
    sensors = first + SENSORS_APART * motions.MOTIONS.index(slot.motion)
    number, planned = planned_at(slot.motion, objects, first, slot.place, sensors, several=slot.several)
    seed = first + slot.place
    slot.folder.mkdir(parents=True, exist_ok=True)
    output = slot.folder / f"{slot.folder.name}-obj{number:02d}-s{seed}.recording.h5"
    trial = trial_of(planned, seed, output)
    try:
        if isinstance(trial, SimulatedGrasp):
            grasp.simulated.run(trial, force=False, progress=silent)
        else:
            record.simulated.run(trial, force=False, progress=silent)
    except SceneError as error:  # a heavy object would compress a soft gel beyond the layer's limit
        return f"{output.name} is left out: {error}\n"
    return ""


def ship_steps(sizes: Sizes) -> Iterator[Command]:
    """Record motions for the pretrained slip detector, train it on the truth, and put it into the package."""
    some = ("--motions", ",".join(sizes["motions"])) if sizes["motions"] else ()
    for role in FIRST_SEEDS:
        yield script("studies/slip/recordings.py", role, "--out", role, "--per-object", sizes["per_object"], *some)
    folders = [f"{role}/*" for role in FIRST_SEEDS]
    yield evetac("label", *folders, "--method", "truth", "--from-start")
    yield evetac("track", *folders, "--preset", "stable")
    yield evetac("featurize", *folders, "--true-slip-share", "--sticking-share")
    yield evetac("train", "learn/*", "--validate=choose/*/*.features.h5", "--model", "load-path",
                 "--horizon-ms", 10, "--max-steps", sizes["steps"], "--learn-true-slip-share",
                 "--seed", 1, "--out", "models/shipped")  # fmt: skip
    yield script("ship/ship_model.py", "models/shipped/*.model.h5")


STUDY = Study(
    experiments=(
        Experiment(
            "ship", "the pretrained slip detector, trained on many motions, sensors and objects", "data/ship", 1.0,
            full={"motions": (), "per_object": 40, "steps": 2000},  # no motions given: all; 40: the most available
            small={"motions": ("slip", "pushes"), "per_object": 1, "steps": 200},
            steps=ship_steps,
        ),
    ),
)  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Write the recordings of a role."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("role", choices=tuple(FIRST_SEEDS))
    parser.add_argument("--out", type=Path, required=True, help="folder of the recordings, one folder per motion below")
    parser.add_argument("--motions", default="", help="only these, for example slip,pushes")
    parser.add_argument(
        "--per-object", type=int, default=MOST, help="at most this many recordings of each motion per object"
    )
    parser.add_argument("--jobs", type=int, default=1, help="recordings made at the same time")
    chosen = parser.parse_args(arguments)
    names = [name for name in chosen.motions.split(",") if name]
    if unknown := set(names) - set(COUNTS[chosen.role]):
        known = ", ".join(COUNTS[chosen.role])
        parser.error(f"--motions: expected some of {known}, found {', '.join(sorted(unknown))}")
    slots = list(every_one(chosen.role, names, chosen.per_object, chosen.out))
    slots.sort(key=lambda slot: slot.place / slot.several)  # what is there when a run is stopped holds every motion
    if chosen.jobs == 1:
        sys.stdout.writelines(map(make, slots))
    else:
        with multiprocessing.get_context("spawn").Pool(chosen.jobs) as pool:
            sys.stdout.writelines(pool.imap_unordered(make, slots))
    sys.stdout.write(f"{chosen.out}: {len(slots)} recordings\n")


if __name__ == "__main__":
    main()
