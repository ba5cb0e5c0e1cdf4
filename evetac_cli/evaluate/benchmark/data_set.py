"""The public part of a benchmark's folder: its recordings, and the instants at which dots and forces are judged."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.formats.read.read_columns import read_columns
from evetac_cli.text_files import MOST_JSON_BYTES, parse_json, read_text

NAME, VERSION = "evetac-bench", 1
ABOUT = "benchmark.json"
MADE_BY = "make benchmark (docs/benchmark.md)"


class BenchmarkTrial(NamedTuple):
    """A recording to be judged."""

    name: str
    kind: str
    split: str
    sensor: str
    path: Path


@dataclass(frozen=True)
class Benchmark:
    """A benchmark's folder. digest: of what determines its scores; queries: task -> (recording, ms) that are judged."""

    folder: Path
    size: str
    digest: str
    entries: dict[str, BenchmarkTrial]
    mm_per_px: dict[str, float]
    queries: dict[str, list[tuple[str, int]]]

    def of_kinds(self, *kinds: str) -> list[BenchmarkTrial]:
        """Return the recordings of some kinds."""
        return [entry for entry in self.entries.values() if entry.kind in kinds]


def read(folder: Path) -> Benchmark:
    """Read the tables of a folder; InputError if it is not a benchmark of this version, or not complete."""
    about, digest = _about(folder)
    columns = read_columns(folder / "recordings.csv", ("recording", "kind", "split", "sensor"))
    rows = zip(*(columns[name] for name in ("recording", "kind", "split", "sensor")), strict=True)
    entries = {
        name: BenchmarkTrial(name, kind, split, sensor, folder / "inputs" / f"{name}.recording.h5")
        for name, kind, split, sensor in rows
    }
    if entries.keys() != about["recordings"].keys():
        raise InputError(
            "the recordings do not fit the benchmark",
            where=str(folder / "recordings.csv"),
            expected=f"the {len(about['recordings'])} recordings of {ABOUT}",
            found=f"{len(entries)} recordings",
            hint=MADE_BY,
        )
    missing = [str(entry.path) for entry in entries.values() if not entry.path.exists()]
    if missing:
        raise InputError("a recording is missing", where=missing[0], expected=f"{len(entries)} files", hint=MADE_BY)
    scales = read_columns(folder / "sensors.csv", ("sensor", "mm_per_px"))
    mm_per_px = dict(zip(scales["sensor"], map(float, scales["mm_per_px"]), strict=True))
    queries = {}
    for task in ("dots", "force"):
        instants = read_columns(folder / "queries" / f"{task}.csv", ("recording", "ms"))
        queries[task] = [(name, int(ms)) for name, ms in zip(instants["recording"], instants["ms"], strict=True)]
    return Benchmark(folder, str(about["size"]), digest, entries, mm_per_px, queries)


def _about(folder: Path) -> tuple[dict[str, Any], str]:
    """Return benchmark.json and its digest; InputError if it is not that of this version."""
    path = folder / ABOUT
    if not path.exists():
        raise InputError("not a benchmark", where=str(folder), expected=f"a folder with {ABOUT}", hint=MADE_BY)
    text = read_text(path, MOST_JSON_BYTES)
    try:
        about = parse_json(text)
    except ValueError as error:
        raise InputError(f"not valid JSON: {error}", where=str(path)) from None
    found = (about.get("name"), about.get("version")) if isinstance(about, dict) else (None, None)
    if found != (NAME, VERSION) or not isinstance(about.get("recordings"), dict):
        raise InputError("another benchmark", where=str(path), expected=f"{NAME} {VERSION}", found=f"{found}")
    return about, hashlib.sha256(text.encode()).hexdigest()
