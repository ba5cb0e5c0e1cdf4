"""Contract tests for plug-ins of other packages: each function raises AssertionError if a contract is violated.

    from evetac_cli import testing

    def test_my_camera():
        testing.check_camera("mine:7")

evetac's own cameras, grippers, formats, controllers, networks and files pass the same functions. Cameras and grippers
of plug-ins are checked for what is recorded while they run (devices/plugin_devices.py), networks when they are trained.
"""

import dataclasses
import json
import math
import pickle
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import cast

import numpy as np

from evetac_cli import plugins
from evetac_cli.devices import EventCamera, Gripper, cameras, grippers
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.devices.grippers import Mode, NamedGripper
from evetac_cli.devices.opening import require_arm
from evetac_cli.devices.plugin_devices import (
    clock_fault,
    counts_fault,
    reading_fault,
    sensor_fault,
    setup_fault,
    slice_fault,
)
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.events import SLICE_US, Events, slice_starts
from evetac_cli.formats import exports, imports
from evetac_cli.formats.imports import Imported, read_events
from evetac_cli.kernels.grip.control import Control, PluginLaw, SlipSignal
from evetac_cli.kernels.grip.paper import PAPER, GraspPhase
from evetac_cli.kernels.slip.architectures import DotArchitecture, PluginLayers, PluginNetwork, weight_shapes
from evetac_cli.names import Capability
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.plan import first_plan, named_objects, one_sensor
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe

LEAST_MARK = 4  # bytes that a format must begin with: a shorter mark would occur in other files by chance

# Cameras


def check_camera(text: str) -> None:
    """Check a camera, given by name as for `--camera`; it is opened four times and read for half a second."""
    named_camera = cameras.parse(text)
    _check_named(text, named_camera, cameras.parse(str(named_camera)))
    assert named_camera.has(Capability.DEVICE), "a plug-in camera is a device and must have Capability.DEVICE"
    assert named_camera.file_stem and "/" not in named_camera.file_stem, "file_stem must begin file names"
    checks: tuple[Callable[[EventCamera], None], ...] = (check_slices, check_losses, check_clock, check_end)
    for check in checks:
        camera, setup, _ = named_camera.open(CameraSettings(), None, np.random.SeedSequence(0))
        with closing(camera):
            _require_none(setup_fault(setup))
            _require_none(sensor_fault(camera, named_camera.frame_px()))
            check(camera)


def _check_named(text: str, named: NamedCamera | NamedGripper, again: object) -> None:
    """Check a named device; again: what its own text selects."""
    assert text.partition(":")[0] == named.name, f"its name is {named.name}, but it was requested as {text}"
    assert again == named, f"{named}, its text in error messages, does not select it"
    assert pickle.loads(pickle.dumps(named)) == named, "it is not equal to its copy in another process"
    assert named.capabilities <= set(Capability), f"not all of {named.capabilities} are members of Capability"


def check_slices(camera: EventCamera, slices: int = 200) -> None:
    """Check that slice k holds only events of [k, k + 1) ms, in order of time, with the right dtypes, in the frame."""
    width, height = camera.sensor["sensor/frame_px"]
    for index in range(slices):
        _require_none(slice_fault(camera.read(), index, (width, height)), f"slice {index}: ")


def check_end(camera: EventCamera, *, ends: bool = False, slices: int = 210) -> None:
    """Check that a camera returns None after its last slice and once it is closed, and that it can be closed twice.

    ends: whether its stream ends by itself. slices: number of slices to read if it does not.
    """
    count = 0
    while count < slices or ends:
        if camera.read() is None:
            break
        count += 1
    assert count > 0
    assert ends == (camera.read() is None)
    camera.close()
    camera.close()
    assert camera.read() is None
    assert camera.read() is None


def check_losses(camera: EventCamera) -> None:
    """Check that losses are whole numbers by name, before, during and after reading."""
    for _ in range(3):
        _require_none(counts_fault(camera.counted))
        camera.read()
    camera.close()
    _require_none(counts_fault(camera.counted))


def check_clock(camera: EventCamera, *, ends: bool = False) -> None:
    """Check that device time never goes back and is close to the end of the last slice read.

    ends: whether the stream ends by itself; the time must then be exact to the us.
    """
    previous_us = 0
    for index in range(50):
        camera.read()
        _require_none(clock_fault(camera, index + 1, previous_us, 0 if ends else SLICE_US))
        previous_us = camera.now_us()


# Grippers


def check_gripper(text: str, *, armed: bool = False) -> None:
    """Check a gripper, given by name as for `--gripper`; it is opened in both modes and commanded.

    armed: whether real fingers may move, as with --arm; InputError if they would move without it.
    """
    named_gripper = grippers.parse(text)
    require_arm(named_gripper, armed=armed, plan="is closed with 10 mA for five commands", hint="armed=True")
    _check_named(text, named_gripper, grippers.parse(str(named_gripper)))
    assert named_gripper.has(Capability.MOVED), "a gripper must have Capability.MOVED"
    if named_gripper.has(Capability.HARDWARE):
        own = type(named_gripper).release is not NamedGripper.release
        assert own, "a real gripper needs `release`, to switch torque off if the process that commanded it died"
    ways: tuple[tuple[Mode, RhP12RnSettings | None], ...] = (
        ("current", None),
        ("position", named_gripper.settings(max_current_ma=60, watchdog_ms=60)),
    )
    for mode, settings in ways:
        gripper, setup = named_gripper.open(mode, named_gripper.port, settings)
        assert gripper is not None
        assert setup["name"] == named_gripper.name
        _require_none(setup_fault(setup))
        with closing(gripper):
            check_commands(gripper, mode)


def check_commands(gripper: Gripper, mode: Mode) -> None:
    """Check that an open gripper accepts commands of its mode, reads whole ticks, reports torque, and closes twice."""
    start = gripper.read()
    _require_none(reading_fault(start))
    for _ in range(5):
        if mode == "current":
            gripper.write_current(10)
        else:
            gripper.write_position(start.position_ticks)
        _require_none(reading_fault(gripper.read()))
    _require_none(counts_fault(gripper.counted))
    gripper.close()
    gripper.close()
    assert isinstance(gripper.release_words, str)


# Formats


def check_importer(name: str, file: Path) -> Imported:
    """Check an import format of a plug-in with a file; returns the imported data, to compare with the file."""
    row = _plugin(plugins.IMPORTERS, name, imports.ImportFormat)
    head = file.read_bytes()[: max(map(len, row.begins))]
    assert head.startswith(row.begins), "the file does not begin with a mark of its format"
    assert all(len(mark) >= LEAST_MARK for mark in row.begins), "a mark is so short that it may occur by chance"
    read = read_events(file)
    assert read.format == name, f"the file was read as {read.format}"
    assert set(row.options) <= set(imports.OPTIONS), "allowed options are --stream, --columns and --time-unit"
    with tempfile.TemporaryDirectory() as folder:
        for length in range(len(head), file.stat().st_size, max(1, file.stat().st_size // 50)):
            part = Path(folder) / file.name
            part.write_bytes(file.read_bytes()[:length])
            try:  # a truncated file must be read or refused
                read_events(part)
            except InputError:
                continue
    return read


def check_exporter(name: str, folder: Path) -> Path:
    """Check an export format of a plug-in; returns the file, to compare with `small_recording`."""
    row = _plugin(plugins.EXPORTERS, name, exports.ExportFormat)
    assert all(suffix.startswith(".") for suffix in row.suffixes), "suffixes must begin with a dot"
    source = small_recording(folder / "small.recording.h5")
    target = exports.target_path(source, name, None)
    figures = exports.export(source, name, target)
    assert figures["size_bytes"] == target.stat().st_size > 0
    return target


def small_events() -> Events:
    """Return 300 events within 20 ms in a frame of 640 x 480 px, always the same."""
    rng = np.random.default_rng(7)
    columns = (rng.integers(0, high, 300) for high in (640, 480, 2))
    x, y, p = (column.astype(dtype) for column, dtype in zip(columns, (np.uint16, np.uint16, np.uint8), strict=True))
    return Events(np.sort(rng.integers(0, 20 * SLICE_US, 300)).astype(np.int64), x, y, p)


def small_recording(path: Path) -> Path:
    """Write a recording of `small_events` to a path that ends in .recording.h5, and return the path."""
    events, slices = small_events(), 20
    arrays = {f"events/{column}": getattr(events, column) for column in Events._fields}
    arrays |= {"ms_to_idx": slice_starts(events.t, slices), "t_offset": np.int64(0)}
    arrays |= {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "small"}
    write_stage(path, Recipe("recording", 1, {}, content="small", simulated_source=True), arrays)
    return path


# Controllers


def check_controller(name: str) -> None:
    """Check a controller of a plug-in: a frozen dataclass, equal in another process, that answers every step."""
    law = _plugin(plugins.CONTROLLERS, name, PluginLaw)
    assert dataclasses.is_dataclass(law)
    json.dumps(dataclasses.asdict(law), allow_nan=False)
    assert pickle.loads(pickle.dumps(law)) == law, "it is not equal to its copy in another process"
    assert goals(law) == goals(law), "two equal grasps get different commands"


def goals(law: PluginLaw) -> list[int]:
    """Return the goals of a simulated grasp of half a second; they must be whole and in the gripper's range."""
    try:
        return _goals(law)
    except EvetacError as error:  # a grasp would end with this error
        raise AssertionError(str(error)) from error


def _goals(law: PluginLaw) -> list[int]:
    control, position, slips, answers = Control(law), 300, 0, []
    for step in range(250):
        phase = GraspPhase(min(step // 80, 2))
        slips += step % 40 == 0
        signal = SlipSignal(slips, 0.5, 0.1 * step, 0.0)
        ahead = control.copy().step(phase, signal, position)  # as for a slip that is answered before its step
        goal = control.step(phase, signal, position)
        assert type(goal) is int
        assert goal == ahead, "it keeps data outside of its state, or a step of a copied state changes the original"
        assert PAPER.first_tick <= goal <= PAPER.last_tick
        assert math.isfinite(control.u_ff_ticks), "u_ff must be finite for recordings to be valid"
        assert not math.isinf(control.x_ref_ticks), "x_ref must be finite, or NaN if there is none"
        position += int(np.sign(goal - position))
        answers.append(goal)
    return answers


# Networks


def check_network(name: str, rows: int = 7, columns: int = 8) -> None:
    """Check a network of a plug-in for a dot grid: its graph matches its weights and computes the same as torch."""
    from evetac_cli.kernels.slip import networks, onnx_graphs

    architecture = cast(PluginNetwork, _plugin(plugins.NETWORKS, name, PluginLayers))
    assert architecture.name == name, f"its name is {architecture.name}"
    rng = np.random.default_rng(3)
    network = networks.build(architecture, rows, columns)
    weights = networks.weights(network)
    shapes = {layer: array.shape for layer, array in weights.items()}
    assert shapes == weight_shapes(architecture, rows, columns), "layers and modules have different shapes"
    weights = {layer: rng.normal(0.0, 0.3, shape).astype(np.float32) for layer, shape in shapes.items()}
    graph = onnx_graphs.build(architecture, weights, rows, columns)
    onnx_graphs.check(graph, architecture, rows, columns, weights)
    if isinstance(architecture, DotArchitecture):
        sample: tuple[int, ...] = (rows * columns, architecture.inputs_per_dot)
    else:
        sample = architecture.input_shape
    batch = rng.normal(0.0, 1.0, (5, *sample)).astype(np.float32)
    difference = networks.difference_of_forms(architecture, weights, rows, columns, batch)
    assert difference <= 1e-5, f"torch and ONNX return probabilities up to {difference:.3g} apart"


# Scenes, sensors, objects


def check_scene(name: str) -> Scene:
    """Check that a scene of a plug-in can be read, has its name, and can be planned; return the scene."""
    assert plugins.find_file(plugins.SCENES, name) is not None, f"no plug-in has a scene {name}"
    scene = scene_file.load(name)
    assert scene.name == name, f"its name in the file is {scene.name}"
    json.dumps(first_plan(name).parameters(), allow_nan=False)
    return scene


def check_sensor(name: str) -> Sensor:
    """Check that a sensor of a plug-in can be read and simulated in the scene `rest`; return the sensor."""
    assert plugins.find_file(plugins.SENSORS, name) is not None, f"no plug-in has a sensor {name}"
    assert first_plan("rest", sensor=name).sensor_name == name
    return one_sensor(name)


def check_object(name: str) -> TouchedObject:
    """Check that an object of a plug-in can be read; return the object."""
    assert plugins.find_file(plugins.OBJECTS, name) is not None, f"no plug-in has an object {name}"
    ((called, touched),) = named_objects(name).items()
    assert called == name
    return touched


def _require_none(fault: str, where: str = "") -> None:
    assert not fault, f"{where}{fault}"


def _plugin(group: str, name: str, wanted: type[plugins.T]) -> plugins.T:
    """Return the object that a plug-in adds under a name."""
    adds = plugins.find(group, name, wanted)
    assert adds is not None, f"no plug-in adds {name} to {group}, or the name is evetac's own"
    return adds
