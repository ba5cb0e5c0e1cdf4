"""Write the public schemas of simulation files (scene, sensor and object) from the types that define them.

python scripts/schemas.py            # into schemas/
"""

import json
from pathlib import Path
from typing import Any

from evetac_cli.sim.setup.object_file import ObjectFile
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.sensor import SensorFile
from evetac_cli.sim.setup.tables import schema_of

SCHEMAS = Path(__file__).resolve().parents[1] / "schemas"
TYPES: dict[str, tuple[type[Any], str]] = {
    "scene": (Scene, "scene: what is simulated; only the parts it names exist"),
    "sensor": (SensorFile, "sensor: a row of sensors.toml, or a file of --sensor"),
    "object": (ObjectFile, "object: a file of --object, or the object of a TouchSensor"),
}


def text_of(kind: str) -> str:
    """Return the schema of a kind of TOML file, as text."""
    return json.dumps(schema_of(*TYPES[kind]), indent=2, ensure_ascii=False) + "\n"


def main() -> None:
    """Write all schemas."""
    for kind in TYPES:
        (SCHEMAS / f"{kind}.v1.json").write_text(text_of(kind))


if __name__ == "__main__":
    main()
