"""Collect facts of a table from report headers: what was evaluated and trained on, and the method versions."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from evetac_cli.jobs import Row
from evetac_cli.store.layout.ancestry import EARLIER
from scripts.reproduce.results import MODULES, ranges


def report_header(path: Path) -> Row:
    """Return the header of a report, with its history."""
    from evetac_cli.store.files import StageFile

    with StageFile(path, "report") as file:
        header: Row = file.header
        return header


def ancestors(header: Row, history: Row) -> Iterator[Row]:
    """Return a header's ancestors of kinds recording and model, through the files in between.

    The training data of a grasp's model is not included, because the grasp does not contain it.
    """
    for parent in (history[parent_id] for parent_id in header["parents"] if parent_id in history):
        if parent["kind"] in ("recording", "model", "force-model"):
            yield parent
            if parent["kind"] == "recording":  # for a grasp: the detector's model
                yield from (model for model in ancestors(parent, history) if model["kind"] != "recording")
        else:
            yield from ancestors(parent, history)


def _history(header: Row) -> Row:
    return {id_: {**entry, "id": id_} for id_, entry in header["history"].items()}


def model_ids(headers: Iterable[Row]) -> set[str]:
    """Return the recipe ids of the models that the reports judge."""
    nodes = (node for header in headers for node in ancestors(header, _history(header)))
    return {node["id"] for node in nodes if node["kind"] != "recording"}


def facts(headers: Iterable[Row]) -> Row:
    """Return what was evaluated and what was trained on, from the headers of a table's reports."""
    judged: dict[str, Row] = {}
    models: dict[str, Row] = {}
    training: dict[str, Row] = {}
    for header in headers:
        history = _history(header)
        for node in ancestors(header, history):
            (judged if node["kind"] == "recording" else models)[node["id"]] = node
        for model in list(models.values()):
            rows = (row for row in model.get("trajectories", ()) if row["role"] != EARLIER)
            training |= {row["recording"]: {"parameters": row} for row in rows if row["recording"] is not None}

    def parameters(nodes: dict[str, Row], name: str) -> list[Any]:
        values = {json.dumps(node["parameters"].get(name)) for node in nodes.values()} - {"null"}
        return sorted(map(json.loads, values))

    tones = {node["parameters"].get("scene", {}).get("time", {}).get("tone_s", 0.0) for node in judged.values()}
    return {
        "recordings": len(judged),
        "objects": parameters(judged, "object"),
        "sensors": parameters(judged, "sensor"),
        "recording_seeds": sorted({node["seed"] for node in judged.values() if node["seed"] is not None}),
        "models": len(models),
        "training_seeds": sorted(set(parameters(models, "seed"))),
        "training_steps": max(parameters(models, "max_steps"), default=0),
        "training_recordings": len(training),
        "training_objects": parameters(training, "object"),
        "training_sensors": parameters(training, "sensor"),
        "tone_s": max(tones, default=0.0),
    }


COMMANDS = {
    "recording": "record", "labels": "label", "features": "featurize", "model": "train", "force-model": "train-force",
}  # fmt: skip


def methods(headers: Iterable[Row]) -> dict[str, int]:
    """Return the method version of each command behind a table's reports; the oldest if there are several."""
    numbers: dict[str, int] = {}
    for header in headers:
        for node in (header, *header["history"].values()):
            command = node["parameters"].get("command", COMMANDS.get(node["kind"], ""))
            if node["kind"] == "force-model" and node["parameters"].get("method") == "touch":
                command = "train-force --method touch"
            if node["kind"] == "tracks":
                command = "track" if node["seed"] is None else "track-rgb"
            if node["kind"] == "recording" and "controller" in node["parameters"]:
                command = "grasp"
            if command in MODULES:
                numbers[command] = min(node["method"], numbers.get(command, node["method"]))
            for kind, method in node.get("methods", {}).items():  # of the files that a model was trained on
                command = COMMANDS.get(kind, "track")
                numbers[command] = min(method, numbers.get(command, method))
    return {command: numbers[command] for command in MODULES if command in numbers}


def words_for(known: Row) -> Row:
    """Return the facts in words for a title."""
    shown = {name: value for name, value in known.items() if not isinstance(value, list)}
    for name, value in known.items():
        if isinstance(value, list):
            whole = all(isinstance(entry, int) for entry in value)
            shown[name] = ranges(value) if whole else ", ".join(map(str, value))
    return shown
