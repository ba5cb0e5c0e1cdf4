"""The pages of evetac-bench: data card and Croissant metadata."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evetac_cli.console import format_value
from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.hub_card import card_fields, card_text, opening, table
from evetac_cli.inspect.share.sections import UNLIKE, citation, made_with
from evetac_cli.jobs import Row

LICENSE = "mit"  # that of the repository, which has the recipe
TABLES = {
    "recordings.csv": "The recordings to be judged: name, kind, split, and sensor.",
    "sensors.csv": "Scale of each sensor.",
    "queries/dots.csv": "Instants at which the dots are judged.",
    "queries/force.csv": "Instants at which the shear force is judged.",
}
FIELDS = {
    "recording": ("sc:Text", "Name of the recording, without meaning."),
    "kind": ("sc:Text", "slip, handling, vibration, press or lift. Not an input of a method."),
    "split": ("sc:Text", "known-sensor, known-object or all-new."),
    "sensor": ("sc:Text", "Name of the sensor."),
    "mm_per_px": ("sc:Float", "Scale of the image on the gel, in mm per px."),
    "ms": ("sc:Integer", "Slice of 1 ms whose end is judged."),
}
PREDICT = """A method sees only `inputs/`, `sensors.csv` and, for the tasks dots and force, `queries/`. It may use the
kind of a recording only to know which tables expect a row. Write one CSV per task and score them:

```
evetac evaluate benchmark FOLDER --predictions MINE
```

| file | columns | rows |
| --- | --- | --- |
| onset.csv | recording, onset_ms | one for each recording of kind slip; empty if nothing is detected |
| warning.csv | recording, ms, score | scores of slip in each recording of kind slip, handling, vibration or lift |
| force.csv | recording, ms, fx_n, fy_n | one for each row of queries/force.csv |
| dots.csv | recording, ms, dot, x_px, y_px | one for each row of queries/dots.csv and dot, row by row of the grid |

`reader.py` reads the recordings with h5py and numpy alone. docs/benchmark.md of evetac defines the five scores.
`truth/` has what the scorer compares with. The inputs hold no truth, but anyone who has `recipe.toml` and evetac can
make the truth again. The benchmark is for honest comparison and cannot detect cheating."""


def write(folder: Path, about: Mapping[str, Any], rows: Sequence[Row], lifts: Mapping[str, Row]) -> None:
    """Write README.md and croissant.json into the folder."""
    (folder / "README.md").write_text(card(about, rows, lifts))
    (folder / "croissant.json").write_text(json.dumps(croissant(folder, about), indent=1) + "\n")


def title_of(about: Mapping[str, Any]) -> str:
    """Return the title of a benchmark."""
    return f"{about['name']} v{about['version']}, {about['size']}"


def card(about: Mapping[str, Any], rows: Sequence[Row], lifts: Mapping[str, Row]) -> str:
    """Return the data card."""
    title = title_of(about)
    counts = Counter((row["kind"], row["split"]) for row in rows)
    counts.update(("grip, in closed loop", row["split"]) for row in lifts.values())
    splits = sorted({split for _, split in counts})
    kinds = [
        {"kind": kind, **{split: counts[kind, split] for split in splits}}
        for kind in dict.fromkeys(kind for kind, _ in counts)
    ]
    figures = [
        {"": "recordings", "value": len(rows)},
        {"": "duration in s", "value": round(sum(row["slices"] for row in rows) / SLICES_PER_S, 1)},
        {"": "sensors", "value": len({row["true_sensor"] for row in rows})},
        {"": "objects and faces", "value": len({row["true_object"] for row in rows})},
    ]
    page = [
        *opening(title, simulated=True, license_=LICENSE),
        "Recordings of a simulated event-based tactile sensor (Evetac), to compare methods for slip, force, dots and"
        " grip on sensors and objects that no method of evetac was trained on.",
        "## Contents",
        table(figures, format_value),
        table(kinds, format_value),
        "`known-sensor`: the sensor evetac, new objects. `known-object`: new sensors, objects that methods of evetac"
        " were trained on. `all-new`: new sensors and new objects.",
        "## How to use it",
        PREDICT,
        "## Limitations",
        f"- All trials are simulated: no real sensor, object or gripper was involved.\n- {UNLIKE}",
        *citation(None, "data set"),
        *made_with(),
    ]
    return card_text({**card_fields(True, LICENSE), "pretty_name": title, "viewer": False}, page)


def croissant(folder: Path, about: Mapping[str, Any]) -> dict[str, Any]:
    """Return the Croissant metadata of the files in the folder (https://docs.mlcommons.org/croissant)."""
    files = [_file(folder, name, text) for name, text in TABLES.items()]
    inputs = {
        "@type": "cr:FileSet",
        "@id": "inputs",
        "name": "inputs",
        "description": "Recordings to be judged: events, gripper readings, dots at rest.",
        "encodingFormat": "application/x-hdf5",
        "includes": "inputs/*.recording.h5",
    }
    truth = {**inputs, "@id": "truth", "name": "truth", "includes": "truth/*.h5"}
    truth["description"] = "What the scorer compares with. Not an input of a method."
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": f"{about['name']}-v{about['version']}-{about['size']}",
        "description": "Simulated recordings of an event-based tactile sensor (Evetac), to compare methods for slip,"
        " force, dots and grip. All data are simulated.",
        "version": f"{about['version']}.0.0",
        "license": "https://spdx.org/licenses/MIT.html",
        "url": "https://sites.google.com/view/evetac",
        "citeAs": "Funk et al., Evetac: An Event-based Optical Tactile Sensor for Robotic Manipulation, 2024",
        "datePublished": "2026-11-27",
        "distribution": [*files, inputs, truth],
        "recordSet": [_records(folder, name) for name in TABLES],
    }


def _file(folder: Path, name: str, text: str) -> Row:
    content = (folder / name).read_bytes()
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "description": text,
        "contentUrl": name,
        "contentSize": f"{len(content)} B",
        "encodingFormat": "text/csv",
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _records(folder: Path, name: str) -> Row:
    table_name = name.removesuffix(".csv").replace("/", "-")
    columns = (folder / name).read_text().partition("\n")[0].split(",")
    return {
        "@type": "cr:RecordSet",
        "@id": table_name,
        "name": table_name,
        "description": TABLES[name],
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{table_name}/{column}",
                "name": column,
                "description": FIELDS[column][1],
                "dataType": FIELDS[column][0],
                "source": {"fileObject": {"@id": name}, "extract": {"column": column}},
            }
            for column in columns
        ],
    }


CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
