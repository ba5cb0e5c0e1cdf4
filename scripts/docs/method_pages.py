"""Build the pages of named choices: tracker and training presets, label methods, controllers and models.

Names, constants and their meanings come from the tables in the code. The descriptions are written here.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from typing import Any

from evetac_cli.commands.label import Label
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.kernels.grip.control import LAWS, MOST_FIXED_TICKS
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    LOAD_PATH,
    DotArchitecture,
    MemoryArchitecture,
    weight_shapes,
)
from evetac_cli.kernels.slip.training import ADAPT, PRESETS
from evetac_cli.kernels.tracking import presets
from evetac_cli.kernels.tracking.presets import TrackerConstants
from evetac_cli.resources import MODEL
from scripts.docs.page_text import code, comments, prose, sentence, table, value

ROWS, COLUMNS = 7, 8  # of the cut gel, for which the numbers of weights are given
OWN = "evetac"
PAPERS = "the paper"

TRACKERS = {
    "paper": "The paper's tracker: one gradient step per slice, with the published constants. A regulariser keeps"
    " neighbouring dots together.",
    "paper-5-events": "The paper's tracker, but a dot moves with 5 events or more in its ring instead of 11: the"
    " published code counts two table entries for each event, so its 10 entries are 5 events.",
    "official": "The authors' published code, for dots with a true radius of 8 to 10 px. It loses dots of 15 px.",
    "official-5ms": "The same code as its two readouts run it by default: one step for the events of 5 ms.",
    "unregularised": "The paper's tracker without the grid regulariser: the comparison in the paper.",
    "stable": "evetac's tracker, and the default: it solves for the dot motion that explains the events of a slice,"
    " including their polarity.",
}
TRAININGS = {
    "paper": "The paper's training: plain gradient descent on unnormalised features. `train` stops after 40,000 steps"
    " unless `--max-steps` is given. It tries 49 thresholds; the paper tried 41.",
    "adam": "Adam on normalised features, for short trainings such as the one in the first hour.",
    "adamw": "evetac's training: AdamW on normalised features, with samples scaled at random, a falling learning rate"
    " and averaged weights.",
    "adapt": "Small steps that adapt a trained network to your sensor. `train --adapt` uses this preset.",
}
LABELS = {
    "event-flow": "evetac's method, and the default. It compares the motion of the dots, from the tracker, with that of"
    " the object, from the events in the window. It reports an interval for the onset, and abstains if the events do"
    " not show one.",
    "farneback": "The paper's method: dense optical flow between event images of the window.",
    "dis": "A different dense optical flow (DIS) between the same images.",
    "event-count": "The simplest method: slip is a high number of events in the window, wherever they are.",
    "truth": "The simulation's ground truth of gross slip, for comparison and for training.",
}
CONTROLLERS = {
    "paper": "The paper's control law. In the balance phase it sets its reference at the first slip and closes at every"
    " slip.",
    "paper-reset": "The paper's control law, interpreted so that every slip sets the reference again.",
    "load-proportional": "evetac's control law: grip force in proportion to the load, which it estimates from the"
    " displacement and rotation of the dots. It learns the required proportion from the grip that stops a slide and"
    " from a slow release.",
    "none": "Stays at the position of light contact, without a detector: the control experiment in the paper.",
    "fixed:N": f"Closes N ticks (1 to {MOST_FIXED_TICKS}) beyond light contact and stays there, without a detector.",
}
MODELS = {
    "no-hist": "One slice, no history.",
    "hist10": "The last 10 slices. The default of `train`.",
    "events-only": "The last 10 slices, with event counts only.",
    "disp-only": "The last 10 slices, with displacements only.",
    "hist20": "The last 20 slices.",
    "down5": "The last 50 slices as 10 means of 5 slices, with one prediction every 5 ms.",
    "fast-slow": "Two time scales: the last 10 slices, and 5 means of 10 slices.",
    "no-hist-img": "Baseline on event images, one slice.",
    "hist10-img": "Baseline on event images, 10 slices.",
    "no-hist-img-6x6": "`no-hist-img` on images summed over 6 x 6 px, small enough to train on a CPU.",
    "hist10-img-6x6": "`hist10-img` on images summed over 6 x 6 px, small enough to train on a CPU.",
    "load-path": "Numbers of the contact every 5 ms, from dots, events, the network of the sticking share and the"
    " gripper, with a memory from the first touch on. It is trained by its own recipe, not by a preset. The"
    " pretrained detector has this architecture.",
}
OWN_MODELS = ("no-hist-img-6x6", "hist10-img-6x6", "load-path")
FORCE_MODELS = {
    "paper": "Shear force by a linear regression and by the paper's network, for the dot grid of one sensor.",
    "touch": "evetac's model: shear modulus, creep, offset and normal-force factor of one sensor. Touch maps use these"
    " values to estimate forces.",
}


def pages() -> dict[str, str]:
    """Return the text of every page by its path."""
    return {"presets.md": _presets(), "controllers.md": _controllers(), "models.md": _models()}


def label_methods() -> tuple[str, ...]:
    """Return the methods of `label`."""
    return tuple(Label.__dataclass_fields__["method"].metadata["choices"])


def force_methods() -> tuple[str, ...]:
    """Return the methods of `train-force`."""
    return tuple(TrainForce.__dataclass_fields__["method"].metadata["choices"])


def _constants(named: Mapping[str, Any], meanings: Mapping[str, str]) -> str:
    """Return a table of constants, one row each, with a column for every named set."""
    keys = list(dict.fromkeys(key for constants in named.values() for key in constants))
    rows = [
        (code(key), prose(meanings.get(key, "")), *(value(constants.get(key, "")) for constants in named.values()))
        for key in keys
    ]
    return table(("constant", "meaning", *named), rows)


def _presets() -> str:
    lines = [
        "# Presets and label methods\n",
        "A preset is a named, complete set of an algorithm's constants. If you change a constant by hand, the file"
        " records the preset as `custom from NAME`.\n",
        "## Tracker\n",
        "`evetac track --preset NAME`, `evetac grasp --tracker NAME`, `evetac.DotTracker(gel, preset=NAME)`.\n",
    ]
    for name in presets.PRESETS:
        lines += [f"### Tracker preset {name}\n", TRACKERS[name] + "\n"]
    constants = {name: asdict(each) for name, each in presets.PRESETS.items()}
    lines += ["### Constants of the tracker\n", "Lengths in px.\n", _constants(constants, comments(TrackerConstants))]
    lines += ["## Training\n", "`evetac train --preset NAME`.\n"]
    trainings = {**PRESETS, ADAPT.name: ADAPT}
    for name in trainings:
        lines += [f"### Training preset {name}\n", TRAININGS[name] + "\n"]
    constants = {
        name: {key: item for key, item in asdict(each).items() if key != "name"} for name, each in trainings.items()
    }
    lines += ["### Constants of training\n", _constants(constants, comments(type(ADAPT)))]
    lines += ["## Label methods\n", "`evetac label --method NAME` marks the slices in which the object slips.\n"]
    for name in label_methods():
        lines += [f"### Label method {name}\n", LABELS[name] + "\n"]
    return "\n".join(lines)


def controller_names() -> list[str]:
    """Return all controllers; N is a number of ticks."""
    return [*LAWS, "none", "fixed:N"]


def _controllers() -> str:
    lines = [
        "# Controllers\n",
        "`evetac grasp --controller NAME` chooses how the gripper touches, lifts and holds the object. Each control"
        " step reads the slip signal and the position of the fingers, and returns a goal position in ticks of the"
        " gripper's encoder (0.088 degrees each). There are 500 steps per second unless `--control-hz` is given.\n",
    ]
    for name in controller_names():
        lines += [f"## {name}\n", CONTROLLERS[name] + "\n"]
        law = LAWS.get(name)
        if is_dataclass(law):
            lines.append(_constants({name: asdict(law)}, comments(type(law))))
    lines.append("The [results](../evidence/results.md) show how many objects each controller held, and how firmly.\n")
    return "\n".join(lines)


def _models() -> str:
    lines = [
        "# Models\n",
        "## Slip detectors\n",
        "`evetac train --model NAME`. A detector estimates the probability of slip from the dots or event images of the"
        f" last slices. Numbers of weights are for {ROWS} x {COLUMNS} dots.\n",
    ]
    for name, architecture in ARCHITECTURES.items():
        of = OWN if name in OWN_MODELS else PAPERS
        weights = sum(
            math.prod(shape)
            for key, shape in weight_shapes(architecture, ROWS, COLUMNS).items()
            if not key.startswith("input_")
        )
        facts = [
            ("from", of),
            ("history", f"{architecture.history} ms"),
            ("one prediction every", f"{architecture.every} ms"),
        ]
        if isinstance(architecture, DotArchitecture):
            facts.append(("inputs per dot", f"{architecture.inputs_per_dot}, of {_channels(architecture)}"))
        elif isinstance(architecture, MemoryArchitecture):
            facts[1] = ("history", "the contact so far")
            facts.append(("inputs per step", str(len(LOAD_PATH))))
        else:
            facts.append(("input", f"{' x '.join(map(str, architecture.input_shape))} (slices, height, width)"))
        facts.append(("weights", f"{weights:,}"))
        lines += [f"### {name}\n", MODELS[name] + "\n", table(("what", "value"), facts)]
    lines += [f"## The detector that comes with evetac: {MODEL.name.removesuffix('.model.h5')}\n", _shipped()]
    lines += ["## Force models\n", "`evetac train-force --method NAME`.\n"]
    for name in force_methods():
        lines += [f"### Force model {name}\n", FORCE_MODELS[name] + "\n"]
    lines.append("`predict-touch` also estimates forces without a model: see [touch maps](../touch-maps.md).\n")
    return "\n".join(lines)


def _channels(architecture: DotArchitecture) -> str:
    lines = []
    for view in architecture.views:
        parts = [f"{view.recent} slice{'s' if view.recent > 1 else ''}"] if view.recent else []
        parts += [f"{view.means} means of {view.block}"] if view.means else []
        lines.append(f"{view.channel} ({' and '.join(parts)})")
    return ", ".join(lines)


def _shipped() -> str:
    facts = json.loads(MODEL.with_name("slip-10ms.json").read_text())
    assert facts["simulated"]
    rows = [
        ("architecture", f"`{facts['model']}`"),
        ("weights", f"{facts['parameters']:,}"),
        ("predicts", f"{facts['horizon_ms']} ms ahead"),
        ("threshold", value(facts["threshold"])),
        (
            "trained on",
            f"{facts['training']['trained_on']} simulated trajectories, labels `{facts['labels']}`"
            + (", and the true share of the contact that slips" if facts["learned_true_slip_share"] else ""),
        ),
    ]
    more = "Its training data and its accuracy: [the pretrained slip detector](../slip-detector.md).\n"
    return sentence("All training data is simulated") + "\n\n" + table(("what", "value"), rows) + "\n" + more
