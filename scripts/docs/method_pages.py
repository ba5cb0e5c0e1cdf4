"""Pages of what a user chooses by name: presets of tracker and training, label methods, controllers, models.

Names, constants and their meaning come from the tables of the code; what each is for stands here.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from typing import Any

from page_text import code, comments, prose, sentence, table, value

from evetac_cli.commands.label import Label
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.kernels.grip.control import LAWS, MOST_FIXED_TICKS
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, DotArchitecture, weight_shapes
from evetac_cli.kernels.slip.training import ADAPT, PRESETS
from evetac_cli.kernels.tracking import presets
from evetac_cli.kernels.tracking.presets import TrackerConstants
from evetac_cli.resources import MODEL

ROWS, COLUMNS = 7, 8  # of the cut gel, for which numbers of weights are counted
OWN = "ours"
PAPERS = "the paper's"

TRACKERS = {
    "paper": "The paper's tracker: a gradient step a slice, with its printed constants; neighbours hold each other.",
    "official": "The authors' published code, for dots whose true radius is 8 to 10 px. It loses dots of 15 px.",
    "official-5ms": "The same code as its two readouts run it by default: a step for the events of 5 ms.",
    "unregularised": "The paper's tracker without the grid that holds dots together: the paper's comparison.",
    "stable": "Ours, and the default: it solves for the motion that the events of a slice stand for, with polarity.",
}
TRAININGS = {
    "paper": "As the paper trains: plain gradient descent on features as they are. `train` ends it at 40,000 steps if"
    " `--max-steps` does not say otherwise, and tries 49 thresholds, the paper 41.",
    "adam": "Adam on normalised features: for trainings of few steps, as in the first hour.",
    "adamw": "Ours: normalised features, samples made stronger and weaker, a falling learning rate, averaged weights.",
    "adapt": "Small steps from a trained network's weights to those for your sensor: what `train --adapt` takes.",
}
LABELS = {
    "event-flow": "Ours, and the default: dots by the tracker, the object by events of its window. It says in which"
    " interval the onset lies, and abstains where it cannot tell.",
    "farneback": "The paper's: dense optical flow between event images of the window.",
    "dis": "Another optical flow (DIS) between the same images.",
    "event-count": "Many events in the window, no matter where: the simplest.",
    "truth": "Gross slip as the simulation knows it: for comparison, and to train on.",
}
CONTROLLERS = {
    "paper": "The paper's law. In balance it sets its reference at the first slip and closes at every slip.",
    "paper-reset": "The paper's law, read so that the reference is set anew at every slip.",
    "load-proportional": "Ours: grips in proportion to the load, which displacement and turn of the dots show; what"
    " stops a slide and what a slow release shows tell how much of it is needed.",
    "none": "Stays where light contact ended: the paper's control experiment, without a detector.",
    "fixed:N": f"Closes N ticks, 1 to {MOST_FIXED_TICKS}, beyond light contact and stays, without a detector.",
}
MODELS = {
    "no-hist": "One slice, no history.",
    "hist10": "The last 10 slices. The default of `train`.",
    "events-only": "The last 10 slices, numbers of events alone.",
    "disp-only": "The last 10 slices, displacements alone.",
    "hist20": "The last 20 slices.",
    "down5": "50 slices as 10 means of 5, one prediction every 5 ms.",
    "fast-slow": "The last 10 slices and 5 means of 10: two time scales.",
    "no-hist-img": "Baseline on event images, one slice.",
    "hist10-img": "Baseline on event images, 10 slices.",
    "no-hist-img-6x6": "As `no-hist-img` on images summed over 6 x 6 px, so that a CPU can train it.",
    "hist10-img-6x6": "As `hist10-img` on images summed over 6 x 6 px, so that a CPU can train it.",
    "disp-xy": "Directions and changes of displacement, and events, over 50 ms. The package's detector is one.",
    "disp-xy-grip": "As `disp-xy`; and, where they are known, changes of the gripper's position and command, and which"
    " share of the contact sticks.",
}
OWN_MODELS = ("no-hist-img-6x6", "hist10-img-6x6", "disp-xy", "disp-xy-grip")
FORCE_MODELS = {
    "paper": "Shear force by a linear regression and by the paper's network, for the dot grid of one sensor.",
    "touch": "Shear modulus, creep, offset and the factor of the normal force, with which touch maps of one sensor tell"
    " its forces. Ours.",
}


def pages() -> dict[str, str]:
    """The text of every page by its path."""
    return {"presets.md": _presets(), "controllers.md": _controllers(), "models.md": _models()}


def label_methods() -> tuple[str, ...]:
    """The methods of `label`."""
    return tuple(Label.__dataclass_fields__["method"].metadata["choices"])


def force_methods() -> tuple[str, ...]:
    """The methods of `train-force`."""
    return tuple(TrainForce.__dataclass_fields__["method"].metadata["choices"])


def _constants(named: Mapping[str, Any], meanings: Mapping[str, str]) -> str:
    """A table of constants, a row each, with a column for every set of them."""
    keys = list(dict.fromkeys(key for constants in named.values() for key in constants))
    rows = [
        (code(key), prose(meanings.get(key, "")), *(value(constants.get(key, "")) for constants in named.values()))
        for key in keys
    ]
    return table(("constant", "meaning", *named), rows)


def _presets() -> str:
    said = [
        "# Presets and label methods\n",
        "A preset is a named, complete set of an algorithm's constants. A constant that is changed by hand is recorded"
        " in the file as `custom from NAME`.\n",
        "## Tracker\n",
        "`evetac track --preset NAME`, `evetac grasp --tracker NAME`, `evetac.DotTracker(gel, preset=NAME)`.\n",
    ]
    for name in presets.PRESETS:
        said += [f"### Tracker preset {name}\n", TRACKERS[name] + "\n"]
    constants = {name: asdict(each) for name, each in presets.PRESETS.items()}
    said += ["### Constants of the tracker\n", "Lengths in px.\n", _constants(constants, comments(TrackerConstants))]
    said += ["## Training\n", "`evetac train --preset NAME`.\n"]
    trainings = {**PRESETS, ADAPT.name: ADAPT}
    for name in trainings:
        said += [f"### Training preset {name}\n", TRAININGS[name] + "\n"]
    constants = {
        name: {key: item for key, item in asdict(each).items() if key != "name"} for name, each in trainings.items()
    }
    said += ["### Constants of training\n", _constants(constants, comments(type(ADAPT)))]
    said += ["## Label methods\n", "`evetac label --method NAME`: when the object slips.\n"]
    for name in label_methods():
        said += [f"### Label method {name}\n", LABELS[name] + "\n"]
    return "\n".join(said)


def controller_names() -> list[str]:
    """All controllers; N stands for a number of ticks."""
    return [*LAWS, "none", "fixed:N"]


def _controllers() -> str:
    said = [
        "# Controllers\n",
        "`evetac grasp --controller NAME`: what the gripper does when the object is touched, lifted and held. A step"
        " takes the slip signal and the fingers' position, and gives a goal position in ticks of the gripper's encoder"
        " (0.088 degrees each), 500 times a second unless `--control-hz` says otherwise.\n",
    ]
    for name in controller_names():
        said += [f"## {name}\n", CONTROLLERS[name] + "\n"]
        law = LAWS.get(name)
        if is_dataclass(law):
            said.append(_constants({name: asdict(law)}, comments(type(law))))
    said.append("What they hold, and how firmly, is measured in the [results](../results.md).\n")
    return "\n".join(said)


def _models() -> str:
    said = [
        "# Models\n",
        "## Slip detectors\n",
        "`evetac train --model NAME`. A detector sees the dots, or event images, of the last slices and gives the"
        f" probability of slip. Numbers of weights are those for {ROWS} x {COLUMNS} dots.\n",
    ]
    for name, architecture in ARCHITECTURES.items():
        of = OWN if name in OWN_MODELS else PAPERS
        weights = sum(
            math.prod(shape)
            for key, shape in weight_shapes(architecture, ROWS, COLUMNS).items()
            if not key.startswith("input_")
        )
        facts = [
            ("whose", of),
            ("history", f"{architecture.history} ms"),
            ("a prediction every", f"{architecture.every} ms"),
        ]
        if isinstance(architecture, DotArchitecture):
            facts.append(("inputs of a dot", f"{architecture.inputs_per_dot}, of {_channels(architecture)}"))
            if architecture.extras:
                told = ", ".join(view.extra for view in architecture.extras)
                facts.append(("of which told beside it", f"{sum(view.width for view in architecture.extras)}: {told}"))
        else:
            facts.append(("input", f"{' x '.join(map(str, architecture.input_shape))} (slices, height, width)"))
        facts.append(("weights", f"{weights:,}"))
        said += [f"### {name}\n", MODELS[name] + "\n", table(("what", "value"), facts)]
    said += [f"## The detector that comes with evetac: {MODEL.name.removesuffix('.model.h5')}\n", _shipped()]
    said += ["## Force models\n", "`evetac train-force --method NAME`.\n"]
    for name in force_methods():
        said += [f"### Force model {name}\n", FORCE_MODELS[name] + "\n"]
    said.append("Without a model `predict-touch` tells forces, too: [touch maps](../touch-maps.md).\n")
    return "\n".join(said)


def _channels(architecture: DotArchitecture) -> str:
    said = []
    for view in architecture.views:
        parts = [f"{view.recent} slice{'s' if view.recent > 1 else ''}"] if view.recent else []
        parts += [f"{view.means} means of {view.block}"] if view.means else []
        said.append(f"{view.channel} ({' and '.join(parts)}{', as changes' if view.change else ''})")
    return ", ".join(said)


def _shipped() -> str:
    facts = json.loads(MODEL.with_name("slip-10ms.json").read_text())
    assert facts["simulated"]
    rows = [
        ("architecture", f"`{facts['model']}`, {facts['training']['networks']} networks whose logits are averaged"),
        ("weights", f"{facts['parameters']:,}"),
        ("predicts", f"{facts['horizon_ms']} ms ahead"),
        ("threshold", value(facts["threshold"])),
        (
            "trained on",
            f"{facts['training']['trained_on']} simulated trajectories, labels `{facts['labels']}`"
            + (", and the true share of the contact that slips" if facts["learned_true_slip_share"] else ""),
        ),
    ]
    more = "How it was trained and how well it performs: [Pretrained slip detector](../slip-detector.md).\n"
    return sentence("All of it is simulated") + "\n\n" + table(("what", "value"), rows) + "\n" + more
