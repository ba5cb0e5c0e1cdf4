"""The card of a model: its figures, its training data and seeds, its evaluations, and their limitations."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from evetac_cli.commands.share import Share
from evetac_cli.console import format_value
from evetac_cli.errors import InputError
from evetac_cli.formats.write.hub_card import Card, card_fields, inline, opening, table
from evetac_cli.inspect import info, validate
from evetac_cli.inspect.share.sections import UNLIKE, citation, made_with
from evetac_cli.stages.model_files import why_useless
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.ancestry import EARLIER
from evetac_cli.store.layout.provenance import Header
from evetac_cli.text_files import parse_json

KINDS = ("model", "force-model")
WHAT = {"model": "slip detector", "force-model": "force model"}
SHOWN = ("trajectories", "slip_correct", "slip_early", "slip_late", "f1")  # figures of a report
# Figures of `info` that a card states elsewhere, or not at all.
NOT_SHOWN = ("file", "kind", "id", "simulated", "size_bytes", "parameters", "made", "parents", "history", "seed")


def describe(path: Path, reports: Sequence[Path], params: Share) -> Card:
    """Return the card of a model file, with the figures of reports on it; raise InputError for other files."""
    (row,) = info.run([path]).rows
    if row["kind"] not in KINDS:
        raise InputError("not a model", where=str(path), expected="a model, or a folder", found=row["kind"])
    (checked,) = validate.run([path]).rows
    if checked["faults"]:
        hint = "`evetac validate` lists all faults; train the model again"
        raise InputError("an invalid model cannot be shared", where=str(path), found=checked["faults"], hint=hint)
    with StageFile(path) as file:
        header, what = file.header, WHAT[file.kind]
        written = {"model.onnx": file.read("onnx").tobytes()} if file.has("onnx") else {}
        score = (
            float(file.read("checkpoint/score")[int(file.read("checkpoint/chosen"))])
            if file.has("checkpoint")
            else None
        )
        why = why_useless(file) if file.kind == "model" else ""
    note = f"{path} is not a slip detector: {why}" if why else ""
    simulated = bool(header["simulated"])
    figures = {name: value for name, value in row.items() if name not in NOT_SHOWN and value is not None}
    if score is not None:
        figures["validation_score"] = score
    data = list(_data(header))
    judged = [one for report in reports for one in _judged(report, header)]
    title = params.title or f"{path.name.removesuffix('.h5').removesuffix('.' + row['kind'])}: {what}"
    fields = card_fields(simulated, params.license) | {"library_name": "evetac", "pipeline_tag": "robotics"}
    page = [
        *opening(title, simulated=simulated, license_=params.license),
        f"A {what} for an event camera behind a dotted gel, made with evetac. Recipe id `{header['id']}`.",
        f"**This model is not a slip detector:** {why}." if why else "",
        "## The model",
        table([{"": name, "value": value} for name, value in figures.items()], format_value),
        "## Data and seeds",
        f"Training seed: {header['seed']}." if header["seed"] is not None else "",
        table(data, format_value),
        "## Training parameters",
        table([{"parameter": name, "value": value} for name, value in _flat(header["parameters"])], format_value),
        "## Evaluation",
        table(judged, format_value) or NOT_EVALUATED,
        *([ON_VALIDATION] if score is not None else []),
        "## Limitations",
        LIMITS if any(row.get("simulated") == "no" for row in data) else LIMITS_SIMULATED,
        "## Files",
        FILES.format(name=inline(path.name)) + (OTHER_FILES if row["kind"] == "model" else ""),
        *citation(params.author, what),
        *made_with(),
    ]
    written[path.name] = path.read_bytes()  # not a link: a copy of a model is small, and may be changed
    return Card(what, title, simulated, fields, [part for part in page if part], {}, written, note)


NOT_EVALUATED = "This card has no evaluation. `evetac share MODEL REPORT` adds reports of `evetac evaluate`."
ON_VALIDATION = (
    "`validation_score` is the mean of F1 and the share of slips with correct timing. It was measured on the"
    " trajectories that were used to choose checkpoint and threshold; on unseen data the score is lower."
)
LIMITS_SIMULATED = (
    f"The model was trained on simulated data only. Its performance on a real sensor has not been measured. {UNLIKE}"
)
LIMITS = "All figures apply to the sensor, the objects and the motions of the data above."
FILES = (
    "- `{name}`: the model; `evetac info` shows it, `evetac grasp --model` and `evetac evaluate slip --model` use it"
)
OTHER_FILES = """
- `model.onnx`: the same network for ONNX runtime"""


def _data(header: Header) -> Iterator[dict[str, Any]]:
    """Yield a row per use (training, validation), scene, sensor and labels of the recordings."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in header["trajectories"]:
        if row["role"] != EARLIER:
            scene_name = row["scene"] or ("imported" if row["imported"] else "unknown")
            key = (row["role"], scene_name, row["sensor"] or "unknown", row["labels"] or "none")
            groups.setdefault(key, []).append(row)
    for (role, scene_name, sensor, labelled), recordings in groups.items():
        objects = {one["object"] for one in recordings} - {None}
        seeds = {one["seed"] for one in recordings} - {None}
        yield {
            "used": role,
            "scene": scene_name,
            "sensor": sensor,
            "labels": labelled,
            "trajectories": len(recordings),
            "objects": ", ".join(sorted(map(str, objects), key=lambda text: (len(text), text))) or "unknown",
            "seeds": _range(seeds),
            "simulated": "yes" if any(one["simulated"] for one in recordings) else "no",
        }
    for model in (one for id_, one in header["history"].items() if id_ in header["parents"]):
        yield {
            "used": "adapted from",
            "scene": f"model {model['id'][:12]}",
            "sensor": None,
            "labels": None,
            "trajectories": None,
        }


def _range(seeds: set[int]) -> str:
    if not seeds:
        return "none"
    return f"{min(seeds)}" if len(seeds) == 1 else f"{min(seeds)} to {max(seeds)}"


def _judged(report: Path, header: Header) -> Iterator[dict[str, Any]]:
    """Yield the figures of each setting in a report; raise InputError if it is not a report on this model only."""
    with StageFile(report, "report") as file:
        history = file.header["history"]
        models = [id_ for id_ in file.header["parents"] if history.get(id_, {}).get("kind") in KINDS]
        if models != [header["id"]]:
            others = ", ".join(id_[:12] for id_ in models) or "no model"
            expected = f"a report of `evetac evaluate slip` on the model {header['id'][:12]} only"
            raise InputError("the report is not on this model", where=str(report), expected=expected, found=others)
        simulated = "yes" if file.header["simulated"] else "no"
        for row in parse_json(file.read("rows")):
            if "seeds" in row and "trajectories" in row:
                figures = {name: row.get(name) for name in SHOWN}
                yield {"evaluation": str(file.read("command")), **figures, "simulated": simulated}


def _flat(parameters: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield parameters, also nested ones, by their path."""
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        elif value is not None:
            yield f"{before}{name}", value
