"""Put the slip detector into the package that `grasp` uses by default, and beside it how it was made.

    python scripts/ship/ship_model.py MODELS/disp-xy-10ms-s*.model.h5 ship.report.h5

Of the seeds it takes the one that was best on the validation trajectories. Its figures on objects never seen are copied
from the report; they have no part in the choice.
"""

import json
import shutil
import sys
from pathlib import Path

from evetac_cli.resources import MODEL
from evetac_cli.stages.evaluate.slip_models import Model
from evetac_cli.store.files import StageFile

FIGURES = ("slip_early", "slip_correct", "slip_late", "f1", "trajectories", "objects")


def validation_score(path: Path) -> float:
    with StageFile(path, "model") as file:
        return float(file.read("checkpoint/score")[int(file.read("checkpoint/chosen"))])


def main() -> None:
    *paths, report = map(Path, sys.argv[1:])
    best = max(paths, key=validation_score)
    model = Model.read(best)
    with StageFile(report, "report") as file:
        rows = json.loads(file.read("rows"))
    chosen = model.header["parameters"]
    traits = {key: chosen[key] for key in ("model", "preset", "max_steps", "folds")}
    traits |= {"horizon_ms": model.horizon_ms, "labels": model.labels}
    (setting,) = [row["setting"] for row in rows if "seeds" in row and traits.items() <= row.items()]
    one = {"setting": setting, "seed": chosen["seed"]}
    (figures,) = [row for row in rows if "threshold" in row and one.items() <= row.items()]
    made = {
        "model": model.architecture.name,
        "horizon_ms": model.horizon_ms,
        "threshold": model.threshold,
        "parameters": model.parameters,
        "training": model.header["parameters"],
        "labels": model.labels,
        "objects_trained_and_validated_on": sorted(map(int, model.objects)),
        "validation_score": validation_score(best),
        "best_of_seeds": len(paths),
        "unseen_objects": {key: figures[key] for key in FIGURES},
        "simulated": model.header["simulated"],
        "id": model.header["id"],
    }
    MODEL.parent.mkdir(exist_ok=True)
    shutil.copyfile(best, MODEL)
    MODEL.with_suffix("").with_suffix(".json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
