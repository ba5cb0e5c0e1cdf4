"""Recordings of the motions that slip detectors are trained on and chosen by, written as `record` and `grasp` do.

`python scripts/motion_recordings.py learn --out FOLDER` writes those of TRAINED objects into FOLDER/MOTION, `choose`
those of CHOSEN_BY objects. Every second one is of a randomised sensor. What is there is not made again. Seeds:
scripts/seeds.json, group `slip detectors trained on motions`.
"""

import argparse
import sys
from pathlib import Path

import motions
from motions import Planned
from slip_trials import planned_at

from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import SceneError
from evetac_cli.jobs import silent
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.settings import GraspSettings, SimulatedGrasp
from evetac_cli.trials.trial import SimulatedTrial

FIRST_SEEDS = {"learn": 5000, "choose": 5600}
OBJECTS = {"learn": motions.TRAINED, "choose": motions.CHOSEN_BY}
# Trials per object; fast jerks, weights and the data-rate scene are kept for the judge.
COUNTS = {
    "learn": {
        **{"slip": 8, "slip-varied": 8, "slip-speeds": 40, "handling": 4, "pushes": 6, "grip": 5, "jerks": 4},
        **{"lifting": 2, "opening": 5, "light touch": 2, "vibration": 3},
    },
    "choose": {
        **{"slip": 4, "slip-speeds": 8, "handling": 2, "pushes": 4, "grip": 3, "jerks": 2},
        **{"lifting": 2, "opening": 4, "light touch": 2, "vibration": 2},
    },
}
SENSORS_APART = 30  # numbers of the first random sensors of two motions; within a motion, no two trials share one


def trial_of(planned: Planned, seed: int, output: Path) -> SimulatedTrial:
    """The trial of a plan as a job of `record`, or of `grasp` where something is lifted."""
    named = ((), output, 0, seed, planned.plan)
    if planned.plan.scene.kind != "lift":
        return SimulatedTrial(*named)
    law = f"fixed:{planned.beyond_ticks}"
    settings = GraspSettings.of(Grasp(controller=law, lift_s=planned.lift_s, balance_s=planned.balance_s))
    return SimulatedGrasp(*named, settings, settings.timing(planned.plan.scene.time.touch_s))


def main() -> None:
    """Write the recordings of a role."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("role", choices=tuple(FIRST_SEEDS))
    parser.add_argument("--out", type=Path, required=True, help="folder of the recordings, one folder per motion below")
    parser.add_argument("--share", default="0/1", help="I/N: every N-th trial from the I-th on, to share the work")
    chosen = parser.parse_args()
    objects, first = OBJECTS[chosen.role], FIRST_SEEDS[chosen.role]
    own, of = map(int, chosen.share.split("/"))
    for motion, count in COUNTS[chosen.role].items():
        folder = chosen.out / motion.replace(" ", "-")
        folder.mkdir(parents=True, exist_ok=True)
        for place in range(own, count * len(objects), of):
            sensors = first + SENSORS_APART * motions.MOTIONS.index(motion)
            number, planned = planned_at(motion, objects, first, place, sensors, several=count * len(objects))
            output = folder / f"{folder.name}-obj{number:02d}-s{first + place}.recording.h5"
            trial = trial_of(planned, first + place, output)
            try:
                if isinstance(trial, SimulatedGrasp):
                    grasp.simulated.run(trial, force=False, progress=silent)
                else:
                    record.simulated.run(trial, force=False, progress=silent)
            except SceneError as error:  # a heavy object on a soft gel, beyond what the layer can be pressed
                sys.stdout.write(f"{output.name} is left out: {error}\n")
        sys.stdout.write(f"{motion}: {count * len(objects)} recordings\n")


if __name__ == "__main__":
    main()
