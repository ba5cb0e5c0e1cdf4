"""Put the pretrained slip detector, the default of `grasp`, into the package, with a record of its training.

    python scripts/ship/ship_model.py models/shipped/load-path-10ms.model.h5

Its results on unseen objects are in the tables `slip-detectors-...` of docs/results, which studies/slip/judge.py makes.
"""

import json
import sys
from pathlib import Path
from typing import Any

from evetac_cli.evaluate.slip.models import Model
from evetac_cli.resources import MODEL
from evetac_cli.stages.model_files import read_curve
from evetac_cli.store.files import StageFile, put_header, replacing
from evetac_cli.store.hdf5.chunks import put
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.ancestry import stored_tables


def validation_score(path: Path) -> float:
    with StageFile(path, "model") as file:
        return float(file.read("checkpoint/score")[int(file.read("checkpoint/chosen"))])


def at_its_threshold(path: Path) -> dict[str, Any]:
    """Return the validation results of the model's warnings and the basis of its calibration, if the model has them."""
    with StageFile(path, "model") as file:
        curve = read_curve(file)
        if curve is None:
            return {}
        false, warned = curve.at(float(file.read("threshold")))
        told: dict[str, Any] = {
            "false_alarms_per_min": false if curve.minutes else None,
            "minutes_without_slip": curve.minutes,
            "warned_10_ms_ahead": warned,
            "slips": curve.slips,
        }
        if file.has("calibration"):
            told["calibrated_on"] = f"{file.read('calibration/slices')} slices of {file.read('calibration/on')}"
        return told


def rewrite(source: Path, target: Path) -> None:
    """Write a model with the same arrays and recipe id, in the newest version of its kind."""
    with StageFile(source, "model") as file:
        header = {**file.header, "version": schema.load("model").version}
        arrays = {name: file.read(name) for name in file.contents()} | stored_tables(header)
    with replacing(target) as h5:
        for name, value in arrays.items():
            put(h5, name, value)
        put_header(h5, header)


def main() -> None:
    (path,) = map(Path, sys.argv[1:])
    model = Model.read(path)
    made = {
        "model": model.architecture.name,
        "horizon_ms": model.horizon_ms,
        "threshold": model.threshold,
        "parameters": model.parameters,
        "training": model.header["parameters"],
        "labels": model.labels,
        "learned_true_slip_share": model.learned_true_slip_share,
        "objects_trained_and_validated_on": sorted(map(int, model.objects)),
        "validation_score": validation_score(path),
        "validated": at_its_threshold(path),
        "simulated": model.header["simulated"],
        "id": model.header["id"],
    }
    MODEL.parent.mkdir(exist_ok=True)
    rewrite(path, MODEL)
    MODEL.with_suffix("").with_suffix(".json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
