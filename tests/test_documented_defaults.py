"""What help texts and docs say in words of the code: defaults, names and ranges that are written down elsewhere.

A parameter whose default is None takes its value from a scene, a model or a module. Its help says which value that is,
and nothing but this test keeps the two together.
"""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli import resources
from evetac_cli.cli import flags
from evetac_cli.commands import every
from evetac_cli.commands.train import FALSE_ALARMS_PER_MIN, LEAST_MINUTES
from evetac_cli.devices.dvxplorer.protocol import DvxplorerSettings
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.evaluate import SUBJECTS
from evetac_cli.formats.read.columns import UNITS, ColumnTimes
from evetac_cli.formats.write.lerobot import event_stacks
from evetac_cli.formats.write.lerobot.contents import Choices
from evetac_cli.kernels.event_representation import Representation
from evetac_cli.sim.setup.plan import HIGHEST_TONE_HZ
from evetac_cli.sim.setup.scene import LIFT_PITCH_MM, Solver
from evetac_cli.stages import train, trim
from evetac_cli.stages.identify import gripper_rows
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import RATE_HZ
from evetac_cli.trials import trial
from evetac_cli.trials.grasp import real_time
from evetac_cli.trials.record import capture_plan

ROOT = Path(__file__).parents[1]
COMMANDS = every() | {f"evaluate {command.name}": command for command in SUBJECTS}


def _shipped() -> str:
    with StageFile(resources.MODEL, "model") as model:
        return f"{model.read('architecture')}, {model.read('horizon_ms')} ms ahead"


def _of_lerobot(name: str) -> Any:
    return getattr(Choices(), name)


def _time_unit(seconds: list[float]) -> str:
    """The unit that these times of an imported file are taken for, where none is named."""
    times = ColumnTimes("a.npz", None)
    times.us(np.array(seconds), str)
    return next(name for name, us in UNITS.items() if us == times.assumed)


# What is documented of a parameter's default, made from the value that the code has.
DOCUMENTED: dict[tuple[str, str], Callable[[], str]] = {
    ("trials", "tolerance_um"): lambda: f"the scene's, or {Solver.tolerance_um}",
    ("trials", "node_pitch_mm"): lambda: (
        f"the scene's, or {Solver.node_pitch_mm}; a simulated `grasp` takes the coarsest of {LIFT_PITCH_MM} to"
        f" {trial.FINEST_MM} that"
    ),
    ("trials", "watchdog_ms"): lambda: f"{RhP12RnSettings.watchdog_ms} to record, {real_time.WATCHDOG_MS} to grasp",
    ("record", "holding_ma"): lambda: f"that of the virtual scene, {capture_plan.HOLDING_MA:g} otherwise",
    ("record", "readout_rate"): lambda: DvxplorerSettings().readout_rate,
    ("record", "time_unit"): lambda: (
        f"{_time_unit([1, 5, 9])} if all times are whole numbers, {_time_unit([0.1, 0.2])} otherwise"
    ),
    ("attach", "offset"): lambda: "0",
    ("calibrate", "gel"): lambda: "that of the recording or the default grid, or closed",
    ("identify", "pixel_mm"): lambda: f"that of --like, taken as known within {gripper_rows.SCALE_SHARE:.0%}",
    ("train", "model"): lambda: f"{train.USUAL.model}, or that of --adapt",
    ("train", "horizon_ms"): lambda: f"{train.USUAL.horizon_ms}, or that of --adapt",
    ("train", "preset"): lambda: f"{train.USUAL.preset}; with --adapt, always adamw with small steps",
    ("train", "max_steps"): lambda: (
        f"{train.USUAL.max_steps}, {train.USUAL_MEMORY.max_steps} for load-path, or {train.ADAPT_STEPS} with --adapt"
    ),
    ("train", "false_alarms_per_min"): lambda: (
        f"{FALSE_ALARMS_PER_MIN:g}; with preset paper, or less than {LEAST_MINUTES:g}"
        " minutes to count in, the paper's rule"
    ),
    ("train", "validate"): lambda: f"every {train.VALIDATE_EVERY}th input",
    ("grasp", "model"): lambda: f"`shipped`, the pretrained {_shipped()}",
    ("grasp", "slip_threshold"): lambda: "the model's own",
    ("trim", "support_ms"): lambda: f"{trim.DV_SUPPORT_MS:g}",
    ("export", "fps"): lambda: f"{RATE_HZ:g} for images of events, {_of_lerobot('fps')} for LeRobot",
    ("export", "polarity"): lambda: Representation.polarity,
    ("export", "bins"): lambda: str(Representation.bins),
    ("export", "decay_ms"): lambda: f"{Representation.decay_ms:g}",
    ("export", "per_frame"): lambda: f"{_of_lerobot('per_frame')} (the default)",
    ("export", "tactile_key"): lambda: str(_of_lerobot("tactile_key")),
    ("export", "size"): lambda: "the sensor's, for LeRobot's event frames {}x{}".format(*event_stacks.SIZE_PX),
}
EVERY = {(name, item.name): item for name, command in COMMANDS.items() for item in dataclasses.fields(command.params)}


def documented_default(text: str) -> str:
    """What a help text says after "default:", to the end of the sentence; or the words before "(the default)"."""
    if after := re.search(r"(?:; d|\. D)efault: ((?:[^.]|\.(?=\S))+)", text):
        return " ".join(after[1].replace(" %", "%").split())
    before = re.search(r"(\S+) \(the default\)", text)
    return f"{before[1]} (the default)" if before else ""


def has_a_value(text: str, choices: tuple[str, ...]) -> bool:
    """Whether a default is documented by a number, or by one of the parameter's choices, and not in words alone."""
    return bool(re.search(r"\d", text)) or any(re.search(rf"\b{re.escape(choice)}\b", text) for choice in choices)


def key_of(command: str, name: str) -> tuple[str, str]:
    """A parameter by its command; record and grasp share those of their trials."""
    return ("trials", name) if ("trials", name) in DOCUMENTED and command in ("record", "grasp") else (command, name)


def test_documented_defaults_are_those_of_the_code() -> None:
    """Assert that a default that help names by its value is the one that the code has."""
    for (command, name), item in EVERY.items():
        documented = documented_default(item.metadata["help"])
        key = key_of(command, name)
        if key in DOCUMENTED:
            assert documented.startswith(DOCUMENTED[key]()), (command, name)
        else:
            undocumented = f"add {key} to DOCUMENTED, beside what the code has"
            assert not has_a_value(documented, item.metadata["choices"]), undocumented


def test_no_parameter_says_two_defaults() -> None:
    """Assert that help names no default by hand where it is printed from the parameter."""
    for (command, name), item in EVERY.items():
        if item.default not in (None, False, ""):
            assert not documented_default(item.metadata["help"]), (command, name)


def test_every_entry_is_of_a_parameter() -> None:
    """Assert that the table above speaks of parameters that there are."""
    shown = {key_of(command, name) for command, name in EVERY}
    assert set(DOCUMENTED) <= shown


def test_flags_of_running_say_no_number() -> None:
    """Assert that help of how to run names no value by hand: it is printed from the table."""
    for command in COMMANDS.values():
        for _, default, _, help_ in flags.running(command).values():
            assert not re.search(r"\d", documented_default(help_)), help_
            assert default is None or not documented_default(help_), help_


def test_the_table_of_settings_in_the_docs() -> None:
    """Assert that every default in the table of docs/simulator.md is the code's."""
    rows = re.findall(r"^\| `(\w+)` \| [^|]*\| ([^|]+) \|", (ROOT / "docs" / "simulator.md").read_text(), re.MULTILINE)
    names = {item.name for item in dataclasses.fields(Solver)}
    documented = {name: value for name, value in rows if name in names}
    assert set(documented) == names
    for name, value in documented.items():
        default = getattr(Solver, name)
        assert value.removeprefix("the scene's, or ") == (
            "none" if default is None else f"{default:g}".replace("e-0", "e-")
        ), name


@pytest.mark.parametrize(
    ("command", "name", "documented"),
    [
        ("record", "tones", f"1 to {HIGHEST_TONE_HZ:g}"),
        (
            "record",
            "objects",
            f"{min(resources.table('objects'), key=int)} to {max(resources.table('objects'), key=int)}",
        ),
        (
            "grasp",
            "objects",
            f"{min(resources.table('objects'), key=int)} to {max(resources.table('objects'), key=int)}",
        ),
        ("train", "validate", f"at least {train.FEWEST_VALIDATED_ON}"),
    ],
)
def test_ranges_in_help_are_those_of_the_code(command: str, name: str, documented: str) -> None:
    """Assert that a range that help says in words is the one that is checked."""
    assert documented in EVERY[command, name].metadata["help"]
