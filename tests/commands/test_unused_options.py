"""No option of `record`, `grasp`, `train-force` and `predict-touch` is ignored without a word."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.record import Record
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.devices.cameras import parse
from evetac_cli.errors import InputError
from evetac_cli.stages.force import train_force
from evetac_cli.stages.touch import predict_touch
from evetac_cli.trials import grasp, record

FILE = {"source": Path("one.txt")}
REPLAY = {"camera": "replay:a.recording.h5"}
PREPARED = {"camera": "virtual:prepared"}
PREVIEW = {"camera": "dvxplorer", "preview": True}


def refuse_unused(params: Record | Grasp) -> None:
    """Refuse as a stage does, which knows the devices."""
    if isinstance(params, Record):
        record._refuse_unused(params, *record.devices(params))
    else:
        grasp._refuse_unused(params, parse(params.camera))


def without_needs(params: type) -> set[str]:
    """The options of a command that have an effect in every run."""
    return {item.name for item in fields(params) if not item.metadata["needs"]}


@pytest.mark.parametrize(
    ("run", "option", "flag", "belongs"),
    [
        ({}, {"seconds": 3.0}, "--seconds", "a device .* or --preview"),
        ({}, {"closing_ma": 20}, "--closing-ma", "a gripper that moves"),
        ({}, {"calibration": Path("a.json")}, "--calibration", "an import .* or a recording from a device"),
        ({}, {"stream": "a"}, "--stream", "an import"),
        ({}, {"frame_size": "640x480"}, "--frame-size", "an import"),
        ({}, {"resume": True}, "--resume", "a recording from a device"),
        ({}, {"threshold_on": 3}, "--threshold-on", "a camera with settings"),
        (FILE, {"seconds": 3.0}, "--seconds", "a device"),
        (FILE, {"objects": "3"}, "--object", "a simulated scene"),
        (FILE, {"scene": "data-rate"}, "--scene", "a simulated scene"),
        (FILE, {"count": 2}, "--count", "a simulated scene .* or a device"),
        (FILE, {"live": True}, "--live", "a simulated scene .* or a recording from a device"),
        ({"live": True}, {"seconds": 3.0}, "--seconds", "a device .* or --preview"),
        ({}, {"live_in": "browser"}, "--live-in", "a live view"),
        (REPLAY, {"readout_rate": "variable-5000"}, "--readout-rate", "a camera with settings"),
        (REPLAY, {"sensor": "second"}, "--sensor", "a simulated scene"),
        (PREPARED, {"scene": "data-rate"}, "--scene", "a simulated scene"),
        ({"camera": "dvxplorer"}, {"lowest_ma": 3.0}, "--lowest-ma", "a gripper that moves"),
        ({"camera": "dvxplorer"}, {"sort": True}, "--sort", "an import"),
        ({"camera": "virtual"}, {"tones": "200"}, "--tone", "in simulated time"),
        (PREVIEW, {"expected_event_rate": 1e4}, "--expected-event-rate", "a recording from a device"),
        ({**PREVIEW, "gripper": "/dev/ttyUSB0"}, {"hold_s": 3.0}, "--hold-s", "a gripper that moves"),
    ],
)
def test_options_of_another_source(run: dict[str, Any], option: dict[str, Any], flag: str, belongs: str) -> None:
    """Assert that an option without effect is refused by name, with what it needs; without it all is well."""
    refuse_unused(Record(**run))
    with pytest.raises(InputError, match=f"^{flag}: has no effect in this run: it needs .*{belongs}"):
        record.jobs([], Record(**run, **option), None)


@pytest.mark.parametrize(
    "flags",
    [
        {"tones": "200", "scene": "vibration", "count": 3, "seed": 4, "sensor": "second", "readout": "ideal"},
        {"preview": True, "seconds": 3.0, "live_in": "terminal"},
        {"live": True, "live_in": "browser"},
        {**FILE, "frame_size": "640x480", "sort": True, "stream": "a", "calibration": Path("a.json")},
        {"camera": "virtual", "scene": "data-rate", "objects": "3", "count": 2, "seconds": 3.0, "hold_s": 3.0},
        {**PREPARED, "threshold_on": 3, "gripper": "none", "expected_event_rate": 1e4},
        {"camera": "dvxplorer", "gripper": "/dev/ttyUSB0", "closing_ma": 20, "resume": True, "seed": 3},
        {**REPLAY, "gripper": "virtual", "lowest_ma": 3.0, "calibration": Path("a.json")},
        {**PREVIEW, "threshold_off": 3, "seconds": 1.0},
    ],
)
def test_options_of_this_source(flags: dict[str, Any]) -> None:
    """Assert that options with an effect are not refused."""
    refuse_unused(Record(**flags))


def test_every_option_belongs_somewhere() -> None:
    """Assert that only what names the source, and what goes with any, needs nothing."""
    assert without_needs(Record) == {"source", "camera", "dry_run"}


@pytest.mark.parametrize("camera", ["sim", "replay:a.recording.h5"])
@pytest.mark.parametrize(
    ("option", "flag"),
    [
        ({"arm": True}, "--arm"),
        ({"calibration": Path("a.json")}, "--calibration"),
        ({"max_current_ma": 30}, "--max-current-ma"),
        ({"max_seconds": 30.0}, "--max-seconds"),
        ({"watchdog_ms": 80}, "--watchdog-ms"),
    ],
)
def test_what_belongs_to_a_moving_gripper(camera: str, option: dict[str, Any], flag: str) -> None:
    """Assert that a grasp in which nothing moves refuses what is for devices, and that one with devices does not."""
    with pytest.raises(InputError, match=f"^{flag}: has no effect in this run: it needs a grasp with devices"):
        grasp.jobs([], Grasp(camera=camera, **option), None)
    refuse_unused(Grasp(camera="virtual", **option))


@pytest.mark.parametrize("option", [{"objects": "3"}, {"sensor": "second"}, {"gel": "closed"}, {"readout": "ideal"}])
def test_what_belongs_to_a_simulated_grasp(option: dict[str, Any]) -> None:
    """Assert that an object or a gel is chosen where they are simulated, and refused where they are what they are."""
    for camera in ("dvxplorer", "replay:a.recording.h5", "virtual:prepared"):
        with pytest.raises(InputError, match="it needs a simulated scene"):
            refuse_unused(Grasp(camera=camera, **option))
    for camera in ("sim", "virtual"):
        refuse_unused(Grasp(camera=camera, **option))


@pytest.mark.parametrize(
    ("run", "option", "belongs"),
    [
        ({}, {"sensor": "evetac"}, "touch-map method"),
        ({}, {"height_mm": 3.0}, "touch-map method"),
        ({"method": "touch"}, {"stiffness_error": 0.2}, "a known sensor"),
        ({"method": "touch"}, {"epochs": 3}, "the paper's method"),
        ({"method": "touch"}, {"samples": 30}, "the paper's method"),
    ],
)
def test_options_of_another_training(run: dict[str, Any], option: dict[str, Any], belongs: str) -> None:
    """Assert that an option that does nothing in a training of forces is refused by name, before files are read."""
    train_force._refuse_unused(TrainForce(**run))
    flag = "--" + next(iter(option)).replace("_", "-")
    with pytest.raises(InputError, match=f"^{flag}: has no effect in this run: it needs .*{belongs}"):
        train_force.jobs([Path("a.tracks.h5")], TrainForce(**run, **option), None)
    assert without_needs(TrainForce) == {"noise_n", "seed"}


def test_options_of_another_prediction() -> None:
    """Assert that --stiffness-error needs the sensor whose error it is, and that a model knows the gel's shape."""
    files = [Path("a.tracks.h5")]
    assert predict_touch.jobs(files, PredictTouch(sensor="evetac", stiffness_error=0.2, height_mm=3.0), None)
    for chosen, flag in (
        (PredictTouch(stiffness_error=0.2), r"--stiffness-error: has no effect .* \(--sensor\)"),
        (PredictTouch(model=Path("own.force-model.h5"), print_depth_mm=0.5), "--print-depth-mm: has no effect"),
        (PredictTouch(model=Path("own.force-model.h5"), sensor="evetac"), "--sensor: an adapted model"),
    ):
        with pytest.raises(InputError, match=f"^{flag}"):
            predict_touch.jobs(files, chosen, None)


def test_options_of_this_training() -> None:
    """Assert that options with an effect are not refused."""
    train_force._refuse_unused(TrainForce(method="touch", sensor="evetac", stiffness_error=0.2, noise_n=0.1))
    train_force._refuse_unused(TrainForce(samples=9, epochs=2, noise_n=0.1))
