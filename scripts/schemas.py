"""Write the public schemas of simulation files (scene, sensor and object) from the types that define them.

python scripts/schemas.py            # into schemas/

The comment `#:` above a field is its description.
"""

import inspect
import json
import re
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import msgspec
from msgspec import Meta

from evetac_cli.sim.setup.object_file import ObjectFile
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.sensor import SENSOR_NAME, Sensor
from evetac_cli.sim.setup.tables import Table, fields_of

SCHEMAS = Path(__file__).resolve().parents[1] / "schemas"
JSON_SCHEMA = "https://json-schema.org/draft/2020-12/schema"


@dataclass(frozen=True, kw_only=True)
class SensorFile(Sensor):
    """A file of --sensor: a sensor and the keys that only a file has."""

    #: name of the sensor in recordings
    name: Annotated[str, Meta(max_length=40, pattern=SENSOR_NAME)] | None = None
    #: named sensor that supplies every key that the file leaves out
    like: Annotated[str, Meta(max_length=40)] | None = None


TYPES: dict[str, tuple[type[Table], str]] = {
    "scene": (Scene, "scene: what is simulated; only the parts it names exist"),
    "sensor": (SensorFile, "sensor: a row of sensors.toml, or a file of --sensor"),
    "object": (ObjectFile, "object: a file of --object, or the object of a TouchSensor"),
}


def text_of(kind: str) -> str:
    """Return the schema of a kind of TOML file, as text."""
    type_, title = TYPES[kind]
    schema = {"$schema": JSON_SCHEMA, "title": title, **rules_of(type_)}
    del schema["description"]
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def rules_of(type_: type[Table]) -> dict[str, Any]:
    """Return the JSON schema of a type's table; the first paragraph of the type's docstring is its description."""
    meaning = (type_.__doc__ or "").split("\n\n")[0].replace("\n    ", " ").rstrip(".")
    hints, comments = get_type_hints(type_, include_extras=True), _comments(type_)
    properties = {}
    for name in (item.name for item in fields(type_)):  # type: ignore[arg-type]
        info, notes = fields_of(type_)[name]
        if isinstance(info, msgspec.inspect.DataclassType):
            rules = rules_of(info.cls)
        else:
            rules = _plain(msgspec.json.schema(hints[name]))
        if "one_number" in notes:
            rules = {"anyOf": [rules["items"], rules]}
        properties[name] = {**rules, "description": comments.get(name) or rules["description"]}
    return {
        "description": meaning[:1].lower() + meaning[1:],
        "type": "object",
        "required": [item.name for item in fields(type_) if item.default is MISSING],  # type: ignore[arg-type]
        "additionalProperties": False,
        "properties": properties,
        **({"minProperties": 1} if type_.NOT_EMPTY else {}),
        **({"not": {"required": list(type_.ALONE)}} if type_.ALONE else {}),
    }


def _comments(type_: type[Any]) -> dict[str, str]:
    """Return the comments above the fields of a type, by the fields' names."""
    source = "".join(inspect.getsource(each) for each in reversed(type_.__mro__[:-2]))
    found = re.findall(r"((?:^    #: .*\n)+)    (\w+):", source, re.MULTILINE)
    return {name: " ".join(re.findall("#: (.*)", text)) for text, name in found}


def _plain(rules: dict[str, Any]) -> dict[str, Any]:
    """Return msgspec's schema of a field without null, and with one schema for all entries of a list."""
    of_value, *_ = rules.pop("anyOf", [{}])
    rules |= of_value
    # 1000 and 1000.0 are equal types, of which Python keeps the first
    rules |= {key: int(end) for key, end in rules.items() if isinstance(end, float) and end.is_integer()}
    if "items" in rules:
        rules["items"] = _plain(rules.pop("prefixItems", [rules["items"]])[0])
    return rules


def main() -> None:
    """Write all schemas."""
    for kind in TYPES:
        (SCHEMAS / f"{kind}.v1.json").write_text(text_of(kind))


if __name__ == "__main__":
    main()
