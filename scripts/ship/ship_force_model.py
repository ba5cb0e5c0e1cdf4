"""Put the force model into the package that `predict-force` uses by default, and beside it how it was made.

python scripts/ship/ship_force_model.py MODELS/gel.force-model.h5
"""

import json
import shutil
import sys
from pathlib import Path

from evetac_cli.resources import FORCE_MODEL
from evetac_cli.stages.force.gel_model import read_gel_model
from evetac_cli.store.files import StageFile


def main() -> None:
    path = Path(sys.argv[1])
    with StageFile(path, "force-model") as file:
        header, model = file.header, read_gel_model(file)
    recordings = [one for one in header["history"].values() if one["kind"] == "recording"]
    network = [*model.network.layers, model.network.linear]
    prior = model.prior
    made = {
        "method": header["parameters"]["method"],
        "parameters": sum(layer.weight.size + layer.bias.size for layer in network),
        "training": {key: header["parameters"][key] for key in ("contacts", "epochs")} | {"seed": header["seed"]},
        "errors_measured_on": {
            "trajectories": len(recordings),
            "sensors": sorted({one["parameters"]["sensor"] for one in recordings}),
        },
        "errors": model.errors._asdict(),
        "prior": {
            "shear_modulus_pa": round(prior.stiffness.shear_mpa * 1e6),
            "shear_log_sd": round(prior.stiffness.shear_log_sd, 3),
            "normal_modulus_pa": round(prior.stiffness.normal_mpa * 1e6),
            "normal_log_sd": round(prior.stiffness.normal_log_sd, 3),
            "mm_per_px": round(prior.mm_per_px, 5),
            "mm_log_sd": round(prior.mm_log_sd, 3),
        },
        "simulated": header["simulated"],
        "id": header["id"],
    }
    FORCE_MODEL.parent.mkdir(exist_ok=True)
    shutil.copyfile(path, FORCE_MODEL)
    FORCE_MODEL.with_suffix("").with_suffix(".json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
