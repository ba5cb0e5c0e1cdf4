"""Words that the second edition gave up, and where they may not come back: `make check` asks for 0 hits.

    python scripts/words.py

A row names an old identifier, what stands in its place, and the kinds of places in which it may not stand. Prose
(comments, docstrings, messages) is free, and so is `found=` of an error.
"""

import ast
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Kinds of places.
NAME = "name"  # of Python: variables, parameters, attributes, functions, classes
MODULE = "module"  # files and folders of evetac_cli
FLAG = "flag"  # options of commands, in code, Makefile and scripts
COMMAND = "command"  # as in `evetac NAME`
DATASET = "dataset"  # of a file, by schemas/
TEXT = "text"  # a string of the code that is this and nothing else: choices, columns, keys of headers
MAKE = "make variable"


@dataclass(frozen=True)
class Word:
    """An old identifier, what it became, where it may not stand, and below which folder (everywhere if empty)."""

    old: str
    new: str
    kinds: tuple[str, ...] = (NAME,)
    under: str | tuple[str, ...] = ""


OUT = ("evetac_cli", "schemas", "scripts", "Makefile")  # tests write files of the old layout, to be refused

WORDS = (
    Word("creep", "disp-xy", (TEXT,), "evetac_cli/kernels/slip"),
    Word("--individual", "--sensor", (FLAG,)),
    Word("individual", "sensor", (NAME, TEXT, DATASET), OUT),
    Word("sensor/individual", "sensor/name", (TEXT, DATASET), OUT),
    Word("INDIVIDUAL", "SENSOR", (MAKE,)),
    Word("drawn", "randomized", (TEXT,), OUT),
    Word("truth/drawn", "truth/sampled_parameters", (TEXT, DATASET)),
    Word("individuals", "sensors", (NAME, TEXT, MODULE)),
    Word("--recipe", "--preset", (FLAG,)),
    Word("RECIPES", "PRESETS", (NAME, MAKE)),
    Word("steady", "adamw", (TEXT,), "evetac_cli"),
    Word("drag_px", "mean_displacement_px", (NAME, TEXT)),
    Word("control/drag_px", "control/mean_displacement_px", (TEXT, DATASET)),
    Word("Felt", "SlipSignal"),
    Word("SlipSense", "OnlineSlipDetector"),
    Word("slip_sense", "online_detector", (NAME, MODULE)),
    Word("grasp_feeling", "detector_process", (NAME, MODULE)),
    Word("grasp_commanding", "controller_process", (NAME, MODULE)),
    Word("Board", "SharedStatus"),
    Word("Sign", "DetectorStatus"),
    Word("tell", "publish"),
    Word("look", "find_cameras, latest, collect_view, read_register"),
    Word("Look", "ViewData"),
    Word("Kept", "TrialBuffer, TrainingState"),
    Word("rgb", "track-rgb", (COMMAND,)),
    Word("fit", "train-force", (COMMAND,)),
    Word("force", "predict-force", (COMMAND,)),
    Word("cut", "trim", (COMMAND, MODULE)),
    Word("by-load", "load-proportional", (TEXT,)),
    Word("by_load", "load_proportional"),
    Word("relatch", "paper-reset", (NAME, TEXT)),
    Word("RELATCH", "PAPER_RESET"),
    Word("--crossings", "--edge-events", (FLAG,)),
    Word("crossings", "edge_events", (NAME, TEXT)),
    Word("--slide-px", "--slip-distance-px", (FLAG,)),
    Word("slide_px", "slip_distance_px", (NAME, TEXT)),
    Word("--ahead", "--horizon-ms", (FLAG,)),
    Word("ahead", "horizon_ms", (NAME, TEXT), "evetac_cli"),
    Word("ahead_ms", "horizon_ms", (NAME, TEXT, DATASET)),
    Word("AHEAD", "--size horizons_ms", (MAKE,)),
    Word("--expect", "--expected-event-rate, --true-hz", (FLAG,)),
    Word("expect", "expected_event_rate, true_hz", (NAME, TEXT), "evetac_cli"),
    Word("told", "error_dict"),
    Word("carry", "attach_outcome"),
    Word("carried", "attached_outcome"),
    Word("ending", "exit_codes", (MODULE,)),
    Word("leftover", "recovery", (MODULE,)),
    Word("beside", "capture", (MODULE,)),
    Word("import_door", "event_validation", (NAME, MODULE)),
    Word("handling", "current_ramp", (MODULE,)),
    Word("closing", "close_until_contact", (MODULE,)),
    Word("idle_options", "unused_options", (NAME, MODULE)),
    Word("hurry", "set_realtime_priority"),
    Word("urgency", "scheduling", (NAME, MODULE)),
    Word("capture/urgency", "capture/scheduling", (TEXT, DATASET)),
    Word("World", "GraspSimulation"),
    Word("Eye", "GelCamera"),
    Word("see", "render"),
    Word("scan_sleep", "pixel_culling", (NAME, MODULE)),
    Word("Sleep", "CandidatePixels"),
    Word("awake", "active"),
    Word("rims", "contact_edges", (NAME, MODULE), "evetac_cli/sim"),
    Word("Rims", "ContactEdges"),
    Word("shrink", "friction_projection", (NAME,), "evetac_cli/sim"),
    Word("way", "search_direction"),
    Word("felt", "friction_wrench, signal"),
    Word("hold", "run_grasp", (NAME,), "evetac_cli/stages/grasp"),
    Word("Held", "GraspResult"),
    Word("SlipAccount", "GroundTruthSlip"),
    Word("rain", "random_event_words"),
    Word("Body", "DeviceModel"),
    Word("Machine", "Host"),
    Word("moments", "frame_times, channel_stats, timing_bins", (NAME, TEXT)),
    Word("--moments", "--images", (FLAG,)),
    Word("law_of", "make_law"),
    Word("model_of", "model_path"),
    Word("timing_of", "make_timing"),
    Word("thing", "object_params"),
    Word("nobody", "dummy dot"),
    Word("NOBODY", "DUMMY_DOT"),
    Word("reduction", "reopened_share", (TEXT,)),
    Word("opening_end_ticks", "opening_after_balance_ticks", (TEXT,)),
    Word("pairs", "flow_pairs", (TEXT,)),
    Word("pairs_computed", "flow_pairs_computed", (TEXT, DATASET)),
    # Not in the table of the review: what its first finding names.
    Word("found", "what it holds"),
    Word("there", "what it holds"),
)


@dataclass(frozen=True)
class Place:
    """Where a word stands."""

    kind: str
    word: str
    file: str
    line: int


def python_places(path: Path) -> Iterator[Place]:
    """Names, whole strings and flags of a Python file."""
    name = str(path.relative_to(ROOT))
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    docstrings = {
        id(node.body[0].value)
        for node in nodes
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    in_errors = {
        id(keyword) for node in nodes if isinstance(node, ast.Call) for keyword in node.keywords
    }  # found=, kept= and the like belong to whoever is called
    for node in nodes:
        line = getattr(node, "lineno", 0)
        if path.name == "errors.py" and isinstance(node, (ast.Name, ast.arg)):
            continue  # the parts of an error are its own
        if isinstance(node, ast.Name):
            yield Place(NAME, node.id, name, line)
        elif isinstance(node, ast.arg):
            yield Place(NAME, node.arg, name, line)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield Place(NAME, node.name, name, line)
        elif isinstance(node, ast.Attribute) and node.attr != "found":  # of an error
            yield Place(NAME, node.attr, name, line)
        elif isinstance(node, ast.keyword) and node.arg and id(node) not in in_errors:
            yield Place(NAME, node.arg, name, line)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield Place(TEXT, node.value, name, line)
            for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]*", node.value):
                yield Place(FLAG, flag, name, line)


def module_places() -> Iterator[Place]:
    """Modules and folders of the package."""
    for path in sorted((ROOT / "evetac_cli").rglob("*.py")):
        for part in path.relative_to(ROOT / "evetac_cli").with_suffix("").parts:
            yield Place(MODULE, part, str(path.relative_to(ROOT)), 0)


def command_places() -> Iterator[Place]:
    """Commands of the command line; those of `evaluate` have their subjects' names."""
    from evetac_cli.cli.main import app

    for command in app.registered_commands:
        yield Place(COMMAND, command.name or "", "evetac_cli/cli/main.py", 0)


def dataset_places() -> Iterator[Place]:
    """Datasets of all kinds of file."""
    for path in sorted((ROOT / "schemas").glob("*.v1.json")):
        for dataset in json.loads(path.read_text(encoding="utf-8")).get("datasets", {}):
            yield Place(DATASET, dataset, str(path.relative_to(ROOT)), 0)


def make_places() -> Iterator[Place]:
    """Variables and flags of the Makefile."""
    for number, line in enumerate((ROOT / "Makefile").read_text(encoding="utf-8").splitlines(), 1):
        for variable in re.findall(r"^([A-Z_]+) *[?:]?=", line):
            yield Place(MAKE, variable, "Makefile", number)
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]*", line):
            yield Place(FLAG, flag, "Makefile", number)


def all_places() -> Iterator[Place]:
    """Every place of the project in which a word of the table may not stand."""
    for folder in ("evetac_cli", "tests", "scripts"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if path.name not in ("words.py", "test_words.py"):
                yield from python_places(path)
    yield from module_places()
    yield from command_places()
    yield from dataset_places()
    yield from make_places()


def hits() -> list[tuple[Word, Place]]:
    """Old words that stand where they may not."""
    rows: dict[str, list[Word]] = {}
    for word in WORDS:
        rows.setdefault(word.old, []).append(word)
    return [
        (word, place)
        for place in all_places()
        for word in rows.get(place.word, ())
        if place.kind in word.kinds and place.file.startswith(word.under)
    ]


def main() -> int:
    """Print every hit, and how many there are."""
    every = hits()
    for word, place in every:
        print(f"{place.file}:{place.line}: {place.kind} `{word.old}`, now: {word.new}")
    print(f"{len(WORDS)} words, {len(every)} hits")
    return bool(every)


if __name__ == "__main__":
    sys.exit(main())
