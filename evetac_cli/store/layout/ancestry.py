"""What a file was made from, according to its header.

A trained file may be made from thousands of files. So its header has of its history only the trained files that it was
adapted from, and two data sets, which are no part of its identity, have the rest: a row for each recording, and kind,
method and parents of each file. A file that is made from a trained one has the rows, and the oldest methods, in the
header of that ancestor.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from types import NoneType
from typing import Any

from evetac_cli.text_files import SEED_BITS, parse_json

Header = dict[str, Any]
Row = dict[str, Any]

TRAINED = ("model", "force-model")
TABLES = ("trajectories", "ancestors", "methods")  # of a header in memory, but not in its JSON
TRAJECTORIES, ANCESTORS = "training/trajectories", "training/ancestors"
TRAINING, VALIDATION, EARLIER = "trained on", "validated on", "earlier"
# The columns of `trajectories` and their types. None is unknown, or nothing of this kind.
COLUMNS: dict[str, tuple[type, ...]] = {
    "recording": (str, NoneType),  # recipe id; None for a file that is not of one recording
    "role": (str,),  # EARLIER: of the model that it was adapted from, or the recording that another was made from
    "scene": (str, NoneType),
    "imported": (bool,),  # from a file of another program
    "object": (int, str, NoneType),
    "sensor": (str, NoneType),
    "sensor_values": (str, NoneType),  # digest of its values, by which sensors are compared; None: only a name is known
    "seed": (int, NoneType),
    "simulated": (bool,),
    "labels": (str, NoneType),  # method
    "tracker": (str, NoneType),  # preset
    "true_slip_share": (bool,),  # whether the true slipping share of the contact was learned
}


def scene_words(parameters: Mapping[str, Any], key: str) -> str | None:
    """Return the `name` or `summary` of the scene from a recording's parameters; None if there is no such text."""
    scene = parameters.get("scene")
    words = scene.get(key) if isinstance(scene, dict) else None
    return words if isinstance(words, str) else None


def recording_of(header: Header, history: Header) -> Header | None:
    """Return the header of the only recording from which a file was made, or its own if it is one; None for several.

    The training files of a model do not count.
    """
    recordings: dict[str, Header] = {}
    waiting, passed = [header], set()
    while waiting:
        one = waiting.pop()
        if one["kind"] == "recording":
            recordings[one["id"]] = one
            continue
        for parent in one["parents"]:
            if parent in history and parent not in passed and history[parent]["kind"] not in TRAINED:
                passed.add(parent)
                waiting.append(history[parent])
    return next(iter(recordings.values())) if len(recordings) == 1 else None


def sensor_values(header: Header) -> str | None:
    """Return the `row_digest` of the simulated sensor from whose recording a file was made, whatever its name.

    None if there is no such recording, or several.
    """
    recording = recording_of(header, header.get("history", {}))
    row = None if recording is None else recording["parameters"].get("sensor_row")
    return row_digest(row) if isinstance(row, dict) else None


def row_digest(row: Mapping[str, Any]) -> str:
    """Return a digest of the values of a sensor; its one-line description does not count."""
    text = json.dumps({key: value for key, value in row.items() if key != "summary"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def trajectories(headers: Iterable[Mapping[str, Any]]) -> list[Row]:
    """Return the rows of all trained files among these, which may be a file and its ancestors."""
    return [row for header in headers for row in header.get("trajectories", ())]


def without_training_files(header: Header) -> Header:
    """Return a header in which trained files have tables instead of the files they were trained on."""
    history = header["history"]
    trained = {id_: one for id_, one in history.items() if one["kind"] in TRAINED}
    if header["kind"] in TRAINED:
        every = {id_: each for one in trained.values() for id_, each in one.get("ancestors", {}).items()}
        every |= {id_: {key: one[key] for key in ("kind", "method", "parents")} for id_, one in history.items()}
        bases = {id_: {key: one[key] for key in one if key not in TABLES} for id_, one in trained.items()}
        tables = {"trajectories": _rows(header), "ancestors": dict(sorted(every.items()))}
        return {**header, "history": bases, **tables, "methods": _oldest(every.values())}
    if not trained:
        return header
    kept: Header = _behind(header["parents"], history, TRAINED)
    for id_ in kept.keys() & trained.keys():
        kept[id_] = {key: value for key, value in trained[id_].items() if key != "ancestors"}
    return {**header, "history": {id_: kept[id_] for id_ in history if id_ in kept}}


def stored_tables(header: Header) -> dict[str, str]:
    """Return the data sets of a trained file's tables; none for another file."""
    if header["kind"] not in TRAINED:
        return {}
    every = header["ancestors"]
    places = {id_: place for place, id_ in enumerate(every)}
    columns = {
        "id": list(every),
        "kind": [one["kind"] for one in every.values()],
        "method": [one["method"] for one in every.values()],
        "parents": [[places.get(parent, parent) for parent in one["parents"]] for one in every.values()],
    }
    return {TRAJECTORIES: _compact(header["trajectories"]), ANCESTORS: _compact(columns)}


def with_tables(header: Header, rows: str, ancestors: str) -> Header:
    """Return the header of a trained file with the tables of its data sets; ValueError if these are invalid."""
    try:
        table = checked_rows(parse_json(rows, whole_bits=SEED_BITS))
        columns = parse_json(ancestors)
        ids = columns["id"]
        every = {
            id_: {
                "kind": kind,
                "method": int(method),
                "parents": [ids[at] if type(at) is int else at for at in parents],
            }
            for id_, kind, method, parents in zip(
                ids, *(columns[n] for n in ("kind", "method", "parents")), strict=True
            )
        }
    except (AttributeError, KeyError, IndexError, TypeError) as error:
        raise ValueError(f"its tables of ancestors are damaged: {error}") from None
    return {**header, "trajectories": table, "ancestors": every, "methods": _oldest(every.values())}


def checked_rows(table: Any) -> list[Row]:
    """Return rows of trajectories as they are read; ValueError for other columns or types."""
    rows: list[Row] = [{"sensor_values": None, **row} for row in table]  # a model made earlier has no such column
    for row in rows:
        if row.keys() != COLUMNS.keys() or not all(isinstance(row[name], COLUMNS[name]) for name in COLUMNS):
            raise ValueError("a row of its trajectories has other columns")
    return rows


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


def _oldest(files: Iterable[Header]) -> dict[str, int]:
    """Return the oldest method version of each kind of file that is not trained."""
    oldest: dict[str, int] = {}
    for one in files:
        if one["kind"] not in TRAINED:
            oldest[one["kind"]] = min(one["method"], oldest.get(one["kind"], one["method"]))
    return oldest


def _behind(ids: Iterable[str], history: Header, ends: tuple[str, ...] = ()) -> Header:
    """Return the ancestors with these ids and all behind them, but none behind a file of the kinds `ends`."""
    found: Header = {}
    waiting = list(ids)
    while waiting:
        id_ = waiting.pop()
        if id_ in history and id_ not in found:
            found[id_] = history[id_]
            waiting += history[id_]["parents"] if history[id_]["kind"] not in ends else []
    return found


def _rows(header: Header) -> list[Row]:
    """Return the rows of a trained file from its parents and their history."""
    history = header["history"]
    parents = [history[id_] for id_ in header["parents"]]
    files = [one for one in parents if one["kind"] not in TRAINED]
    learned = header["parameters"].get("trained_on", len(files))
    truth = bool(header["parameters"].get("learn_true_slip_share"))
    rows = []
    for number, file in enumerate(files):
        around = [file, *(history[id_] for id_ in file["parents"] if id_ in history)]
        role = VALIDATION if number >= learned else TRAINING
        rows.append(_row(recording_of(file, history) or file, role, around, truth=truth and number < learned))
    for base in (one for one in parents if one["kind"] in TRAINED):
        rows += [{**row, "role": EARLIER} for row in base["trajectories"]]
    known = {row["recording"] for row in rows}
    others = (one for id_, one in _behind(header["parents"], history).items() if id_ not in known)
    return rows + [_row(one, EARLIER, [], truth=False) for one in others if one["kind"] == "recording"]


def _row(recording: Header, role: str, around: list[Header], *, truth: bool) -> Row:
    """around: the file that was learned from, and its parents."""
    parameters = recording["parameters"]
    scene = parameters.get("scene")
    labels = next((one["parameters"].get("method", "farneback") for one in around if one["kind"] == "labels"), None)
    tracker = next((one["parameters"].get("preset") for one in around if one["kind"] == "tracks"), None)
    return {
        "recording": recording["id"] if recording["kind"] == "recording" else None,
        "role": role,
        "scene": scene if isinstance(scene, str) else scene_words(parameters, "name"),
        "imported": bool(parameters.get("source")),
        "object": parameters.get("object"),
        "sensor": parameters.get("sensor"),
        "sensor_values": sensor_values(recording),
        "seed": recording["seed"],
        "simulated": recording["simulated"],
        "labels": None if labels is None else str(labels),
        "tracker": tracker,
        "true_slip_share": truth,
    }
