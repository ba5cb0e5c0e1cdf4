"""Law, model, phases and detector of a grasp by its flags; the same in simulation and in real time."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from evetac_cli import resources
from evetac_cli.errors import InputError
from evetac_cli.kernels.grip import control as grip_control
from evetac_cli.kernels.grip.control import Control
from evetac_cli.kernels.sensitivity import Sensitivity
from evetac_cli.kernels.tracking import tracker
from evetac_cli.params.grasp import Grasp
from evetac_cli.sim.setup.plan import Plan, first_plan, read_plan
from evetac_cli.stages import live_view
from evetac_cli.stages.grasp.loop import SLICES_S, Timing
from evetac_cli.stages.grasp.online_detector import OnlineSlipDetector
from evetac_cli.stages.live_view import LiveView
from evetac_cli.stages.live_view.messages import Title
from evetac_cli.stages.slip_detectors import check_graph, require_useful
from evetac_cli.stages.trials import DeviceTrial, SimulatedTrial, Trial
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header
from evetac_cli.store.read import Recording


def make_law(params: Grasp) -> Any:
    """The controller's law; InputError if there is none of that name, or none with that gain."""
    try:
        return grip_control.make_law(params.controller, params.gain)
    except ValueError as error:
        where = "--controller" if params.gain == 1.0 else "--controller, --gain"
        raise InputError("unknown value", where=where, expected=str(error).removeprefix("expected ")) from None


def model_path_for(params: Grasp) -> Path | None:
    """The model file of a grasp's detector: the one named, else the package's; None without a detector."""
    if not grip_control.uses_detector(make_law(params)):
        return None
    return resources.model_file(params.model)


def make_timing(params: Grasp, plan: Plan | None) -> Timing:
    """When the phases end, and how the controller is timed; without a plan, the scene of the flags says the first."""
    if plan is None:
        named = (params.scene, params.objects, params.sensor)
        plan = first_plan(*named, kinds=("lift",), gel=params.gel, readout=params.readout)
    return _timing(params, plan.scene.time.touch_s, params.lift_s, params.balance_s)


def recorded_timing(params: Grasp, recording: Recording) -> Timing:
    """The timing for a recording that is replayed: its own phases, if it is a grasp, else those of the flags."""
    parameters = recording.header["parameters"]
    if not {"scene", "lift_s", "balance_s"} <= set(parameters):
        return make_timing(params, None)
    touch_s = read_plan(parameters, str(recording.path)).scene.time.touch_s
    return _timing(params, touch_s, parameters["lift_s"], parameters["balance_s"])


def _timing(params: Grasp, *seconds: float) -> Timing:
    touch_ms, lift_ms, balance_ms = (round(SLICES_S * each) for each in seconds)
    return Timing(touch_ms, lift_ms, balance_ms, params.control_hz, params.latency_ms)


def open_detector(
    model: StageFile, sensor: Mapping[str, Any], preset: str, slip_threshold: float
) -> OnlineSlipDetector:
    """The detector of a model, for a sensor with these datasets `sensor/...`, with a threshold other than its own."""
    constants = tracker.PRESETS[preset].for_dots(float(sensor["sensor/dot_radius_px"]))
    window_px = sensor.get("sensor/window_px")
    named = {name: f"sensor/{name}" for name in Sensitivity._fields}
    known = Sensitivity(**{name: float(sensor[path]) for name, path in named.items() if path in sensor})
    detector = OnlineSlipDetector.start(model, sensor["sensor/dot_xy_px"], window_px, constants, known)
    detector.threshold = slip_threshold
    return detector


def open_view_detector(
    model_path: Path | None, preset: str, slip_threshold: float | None, sensor: Mapping[str, Any]
) -> OnlineSlipDetector:
    """The detector that a live view follows a recording with; None: the package's model, and the model's threshold."""
    with StageFile(resources.model_file(model_path), "model") as model:
        threshold = float(model.read("threshold")) if slip_threshold is None else slip_threshold
        return open_detector(model, sensor, preset, threshold)


def view_of(trial: SimulatedTrial | DeviceTrial, params: Grasp) -> AbstractContextManager[LiveView | None]:
    """The live view of a grasp, if one is asked for."""
    if not params.live:
        return nullcontext()
    moves = isinstance(trial, DeviceTrial)
    simulated = isinstance(trial, SimulatedTrial) or trial.cameras[0].shows_simulation()
    title = Title(f"grasp {trial.output.name}", simulated, moves)
    open_ = partial(open_view_detector, model_path_for(params), params.tracker, params.slip_threshold)
    return live_view.opened(params.live_in, title, open_)


def grasp_parameters(trial: Trial, params: Grasp, control: Control) -> dict[str, Any]:
    """The parameters of a grasp's recipe."""
    tracking = {"preset": params.tracker, "constants": asdict(tracker.PRESETS[params.tracker])}
    return {
        **({} if trial.plan is None else trial.plan.parameters()),
        "trial": trial.number,
        "controller": params.controller,
        "gain": params.gain,
        "law": control.parameters(),
        "latency_ms": params.latency_ms,
        "control_hz": params.control_hz,
        "tracker": tracking if grip_control.uses_detector(control.law) else None,
        "slip_threshold": params.slip_threshold if grip_control.uses_detector(control.law) else None,
        "lift_s": params.lift_s,
        "balance_s": params.balance_s,
    }


def model_headers(model_path: Path | None) -> tuple[Header, ...]:
    """The header of the detector's model, if there is one, as parents of a recipe; InputError if it is not to be run.

    Why so: asked for before any device is touched, and a graph is better refused now than in the detector's process.
    """
    if model_path is None:
        return ()
    with StageFile(model_path, "model") as model:
        check_graph(model)
        require_useful(model)
        return (model.header,)
