"""Flags that are refused before anything is opened: of no effect in a run, of nothing, or in contradiction."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.record import Record
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.devices.cameras import parse
from evetac_cli.errors import InputError
from evetac_cli.stages.force import train_force
from evetac_cli.stages.touch import predict_touch
from evetac_cli.trials import grasp, record

PORT = "/dev/ttyUSB0"
SIM: dict[str, Any] = {}
FILE = {"source": Path("one.txt")}
DEVICE = {"camera": "dvxplorer"}
VIRTUAL = {"camera": "virtual"}
REPLAY = {"camera": "replay:a.recording.h5"}
PREPARED = {"camera": "virtual:prepared"}
PREVIEW = {"camera": "dvxplorer", "preview": True}
LISTEN = {"listen": True}

# A source, more flags, and the flag that is refused.
RECORD: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    (SIM, {"seconds": 3.0}, "--seconds"),
    (SIM, {"closing_ma": 20}, "--closing-ma"),
    (SIM, {"calibration": Path("a.json")}, "--calibration"),
    (SIM, {"stream": "a"}, "--stream"),
    (SIM, {"resume": True}, "--resume"),
    (SIM, {"threshold_on": 3}, "--threshold-on"),
    (SIM, {"live": True, "seconds": 3.0}, "--seconds"),
    (SIM, LISTEN, "--listen"),
    (SIM, {"gripper": "virtual"}, "--gripper"),
    (FILE, {"seconds": 3.0}, "--seconds"),
    (FILE, {"objects": "3"}, "--object"),
    (FILE, {"scene": "data-rate"}, "--scene"),
    (FILE, {"count": 2}, "--count"),
    (FILE, {"live": True}, "--live"),
    (FILE, DEVICE, "--from"),
    (REPLAY, {"readout_rate": "variable-5000"}, "--readout-rate"),
    (REPLAY, {"sensor": "second"}, "--sensor"),
    (REPLAY, {"gripper": "sim"}, "--gripper"),
    (PREPARED, {"scene": "data-rate"}, "--scene"),
    (DEVICE, {"lowest_ma": 3.0}, "--lowest-ma"),
    (DEVICE, {"sort": True}, "--sort"),
    (DEVICE, {"gripper": "sim"}, "--gripper"),
    (DEVICE, {"listen_port": 5000}, "--listen-port"),
    (DEVICE, {**LISTEN, "resume": True}, "--resume"),
    (DEVICE, {**LISTEN, "count": 2}, "each start is a trial"),
    (DEVICE, {**LISTEN, "gripper": PORT}, "--arm"),
    (VIRTUAL, {"tones": "200"}, "--tone"),
    (VIRTUAL, {**LISTEN, "objects": "1-3"}, "each start is a trial"),
    (VIRTUAL, {**LISTEN, "sensor": "randomized"}, "same sensor"),
    (PREVIEW, LISTEN, "--listen"),
    (PREVIEW, {"expected_event_rate": 1e4}, "--expected-event-rate"),
    (PREVIEW, {"gripper": PORT, "hold_s": 3.0}, "--hold-s"),
    *((SIM, {"camera": name}, "--camera") for name in ("", "simm", "webcam", "replay", "replay:", "sim:3", "Virtual")),
    *((SIM, {"camera": f"virtual:{name}"}, "--camera") for name in ("prepared=x", "bogus", "unplug@2@3", "unplug@2=3")),
    *((SIM, {"camera": names}, "--camera") for names in (",sim", "sim,", "sim,,sim", "dvxplorer:A,sim,dv:A")),
    (SIM, {"camera": "dvexplorer"}, "did you mean dvxplorer"),
    *((DEVICE, {"gripper": name}, "--gripper") for name in ("", "grip", "sim2", "virtual:dead@1")),
    *((DEVICE, {"gripper": f"{PORT}@{rate}"}, "57600") for rate in ("fast", "0", "", "57600.5", "12345", "nan", "-1")),
    *((DEVICE, {"gripper": f"{PORT}:{id_}"}, "0 to 252") for id_ in ("253", "", "five", "-1", "253@57600")),
    (DEVICE, {"gripper": f"{PORT}@57600:5"}, "PORT:ID@BAUD"),
]
OF_DEVICES = (
    ({"arm": True}, "--arm"),
    ({"calibration": Path("a.json")}, "--calibration"),
    ({"max_current_ma": 30}, "--max-current-ma"),
    ({"watchdog_ms": 80}, "--watchdog-ms"),
    (LISTEN, "--listen"),
)
OF_SCENES = (
    ({"objects": "3"}, "--object"),
    ({"sensor": "second"}, "--sensor"),
    ({"gel": "closed"}, "--gel"),
)
GRASP: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    *((source, more, flag) for source in (SIM, REPLAY) for more, flag in OF_DEVICES),
    *((source, more, flag) for source in (DEVICE, REPLAY, PREPARED) for more, flag in OF_SCENES),
    (SIM, {"camera": "webcam"}, "--camera"),
    (SIM, {"gripper": "virtual"}, "--gripper"),
    (SIM, {"controller": "papers"}, "did you mean paper"),
    (SIM, {"controller": "paper"}, "--model"),
    (SIM, {"controller": "fixed:x"}, "fixed:1"),
    (SIM, {"model": Path("nope.h5")}, "nope.h5"),
    (SIM, {"controller": "load-proportional", "gain": 2.0}, "--gain"),
    (SIM, {"control_hz": 300.0}, "--control-hz"),
    (SIM, {"slip_threshold": 0.25, "false_alarms_per_min": 1.0}, "cannot be combined"),
    (SIM, {"controller": "none", "model": Path("slip.model.h5")}, "--model"),
    (SIM, {"controller": "fixed:6", "slip_threshold": 0.5}, "--slip-threshold"),
    (SIM, {"controller": "none", "false_alarms_per_min": 1.0}, "--false-alarms-per-min"),
    (SIM, {"controller": "none", "tracker": "paper"}, "--tracker"),
    (SIM, {"camera": "sim,sim,sim"}, "--camera"),
    (SIM, {"camera": "sim,virtual"}, "--camera"),
    (SIM, {"camera": "virtual,virtual:prepared"}, "--camera"),
    (SIM, {"camera": "sim,sim", "sensor": "evetac,evetac,evetac"}, "--sensor"),
    (SIM, {"camera": "sim,sim", "sensor": "evetac,nobody"}, "--sensor"),
    (SIM, {"sensor": "evetac,evetac"}, "--sensor"),
    (VIRTUAL, {"gripper": "hand"}, "--gripper"),
    (VIRTUAL, {"gripper": "virtual:dead@1"}, "--gripper"),
    (VIRTUAL, {"gripper": PORT}, "--arm"),
    (VIRTUAL, {"latency_ms": 3}, "--latency-ms"),
    (VIRTUAL, {"control_hz": 50.0}, "--control-hz"),
    (VIRTUAL, {"max_seconds": 20.0}, "--max-seconds"),
    (VIRTUAL, {"watchdog_ms": 50}, "--watchdog-ms"),
    (DEVICE, {"gripper": PORT, "arm": True, "watchdog_ms": 70}, "--watchdog-ms"),
]
TRACKS = [Path("a.tracks.h5")]
TRAIN_FORCE: list[tuple[dict[str, Any], str]] = [
    ({"sensor": "evetac"}, "--sensor"),
    ({"height_mm": 3.0}, "--height-mm"),
    ({"method": "touch", "stiffness_error": 0.2}, "--stiffness-error"),
    ({"method": "touch", "epochs": 3}, "--epochs"),
    ({"method": "touch", "samples": 30}, "--samples"),
]
OWN = {"model": Path("own.force-model.h5")}
PREDICT_TOUCH: list[tuple[dict[str, Any], str]] = [
    ({"stiffness_error": 0.2}, "--stiffness-error"),
    ({**OWN, "print_depth_mm": 0.5}, "--print-depth-mm"),
    ({**OWN, "sensor": "evetac"}, "--sensor"),
]
# Flags of `record` that have an effect together.
OF_A_SOURCE: list[dict[str, Any]] = [
    {"tones": "200", "scene": "vibration", "count": 3, "seed": 4, "sensor": "second"},
    {"preview": True, "seconds": 3.0},
    {"live": True},
    {**FILE, "frame_size": "640x480", "sort": True, "stream": "a", "calibration": Path("a.json")},
    {"camera": "virtual", "scene": "data-rate", "objects": "3", "count": 2, "seconds": 3.0, "hold_s": 3.0},
    {**PREPARED, "threshold_on": 3, "gripper": "none", "expected_event_rate": 1e4},
    {"camera": "dvxplorer", "gripper": PORT, "closing_ma": 20, "resume": True, "seed": 3},
    {**REPLAY, "gripper": "virtual", "lowest_ma": 3.0, "calibration": Path("a.json")},
    {**PREVIEW, "threshold_off": 3, "seconds": 1.0},
]


@pytest.mark.parametrize(("source", "more", "flag"), RECORD)
def test_record(source: dict[str, Any], more: dict[str, Any], flag: str, tmp_path: Path) -> None:
    """Assert that a flag of another source, or of nothing, is refused by name, and nothing is written."""
    with pytest.raises(InputError, match=flag):
        record.jobs([], Record(**source | more), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("source", "more", "flag"), GRASP)
def test_grasp(source: dict[str, Any], more: dict[str, Any], flag: str, tmp_path: Path) -> None:
    """Assert that a flag of another source, or of nothing, is refused by name, and nothing is written."""
    with pytest.raises(InputError, match=flag):
        grasp.jobs([], Grasp(**source | more), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("flags", "flag"), TRAIN_FORCE)
def test_train_force(flags: dict[str, Any], flag: str) -> None:
    """Assert that a flag of another method is refused by name, before files are read."""
    with pytest.raises(InputError, match=flag):
        train_force.jobs(TRACKS, TrainForce(**flags), None)


@pytest.mark.parametrize(("flags", "flag"), PREDICT_TOUCH)
def test_predict_touch(flags: dict[str, Any], flag: str) -> None:
    """Assert that a flag of what a model or no sensor knows is refused by name, before files are read."""
    with pytest.raises(InputError, match=flag):
        predict_touch.jobs(TRACKS, PredictTouch(**flags), None)


@pytest.mark.parametrize(
    "words",
    [
        "record --count 2 -o a.recording.h5",
        "record --camera dvxplorer:A,dvxplorer:B -o a.recording.h5",
        "trim a.recording.h5 b.recording.h5 --to-ms 5 -o c.recording.h5",
        "label a.recording.h5 b.recording.h5 --review -o c.labels.h5",
        "label a/a.recording.h5 b/a.recording.h5 -o c",
    ],
)
def test_one_file_holds_one_result(words: str) -> None:
    """Assert that an output that several results would have is refused before anything is read."""
    result = CliRunner().invoke(app, words.split())
    assert result.exit_code == 2 and "one output file cannot hold several results" in result.stderr


@pytest.mark.parametrize("flags", OF_A_SOURCE)
def test_flags_of_this_source(flags: dict[str, Any]) -> None:
    """Assert that flags with an effect are not refused."""
    params = Record(**flags)
    record._refuse_unused(params, *record.devices(params))


def test_flags_of_this_grasp_and_training() -> None:
    """Assert that what is refused of another source or method is accepted of its own."""
    for more, _ in OF_DEVICES:
        grasp._refuse_unused(Grasp(camera="virtual", **more), parse("virtual"))
    for more, _ in OF_SCENES:
        for camera in ("sim", "virtual"):
            grasp._refuse_unused(Grasp(camera=camera, **more), parse(camera))
    train_force._refuse_unused(TrainForce(method="touch", sensor="evetac", stiffness_error=0.2, noise_n=0.1))
    train_force._refuse_unused(TrainForce(samples=9, epochs=2, noise_n=0.1))
    assert predict_touch.jobs(TRACKS, PredictTouch(sensor="evetac", stiffness_error=0.2, height_mm=3.0), None)


@pytest.mark.parametrize(
    ("params", "everywhere"), [(Record, {"source", "dots", "camera", "dry_run"}), (TrainForce, {"noise_n", "seed"})]
)
def test_every_flag_belongs_somewhere(params: type, everywhere: set[str]) -> None:
    """Assert that only what names the source, and what goes with any, needs nothing."""
    assert {item.name for item in fields(params) if not item.metadata["needs"]} == everywhere
