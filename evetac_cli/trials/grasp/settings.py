"""The settings of a grasp, resolved once from its flags (law, detector, timing, gripper), and the trials with them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli import plugins, resources
from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.errors import InputError, did_you_mean
from evetac_cli.events import SLICES_PER_S
from evetac_cli.kernels.grip import control as grip_control
from evetac_cli.kernels.grip.control import Control, Law, PluginLaw
from evetac_cli.kernels.grip.load_law import MARGIN
from evetac_cli.kernels.grip.paper import GripLaw
from evetac_cli.kernels.tracking import presets
from evetac_cli.kernels.tracking.presets import TrackerConstants
from evetac_cli.stages.model_files import chosen_threshold, require_useful
from evetac_cli.stages.slip_detectors import check_graph
from evetac_cli.store.calibration import Calibration
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Header
from evetac_cli.trials.grasp.loop import Timing
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector, dots_for, open_detector
from evetac_cli.trials.trial import DeviceTrial, SimulatedTrial, Trial, ViewRequest

if TYPE_CHECKING:
    from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings


TRAINS_PAPERS = "evetac train FEATURES --model fast-slow --horizon-ms 10 --preset paper -o paper.model.h5"


@dataclass(frozen=True)
class DetectorModel:
    """The checked model of a slip detector, and how it is run.

    header: of its file, a parent of the recording; preset, constants: of the tracker. threshold: the probability that
    three consecutive slices must reach for a slip signal; sticking: whether the signal includes the sticking share.
    """

    path: Path
    header: Header
    preset: str
    constants: TrackerConstants
    threshold: float
    sticking: bool = False

    @classmethod
    def of(cls, params: Grasp, *, sticking: bool = False) -> "DetectorModel":
        """Return the model that the flags name; InputError if it must not be run, or is not useful.

        It is checked before any device is touched, and a faulty graph is refused here rather than in the detector's
        process.
        """
        path = resources.model_file(params.model)
        with StageFile(path, "model") as model:
            model.check()
            check_graph(model)
            require_useful(model)
            header = model.header
            threshold = chosen_threshold(model, params.slip_threshold, params.false_alarms_per_min)
        constants = presets.PRESETS[params.tracker]
        return cls(path, header, params.tracker, constants, threshold, sticking)

    def open(self, sensor: Mapping[str, Any]) -> OnlineSlipDetector:
        """Return the detector for a sensor with these datasets `sensor/...`.

        InputError if its file was replaced meanwhile.
        """
        with StageFile(self.path, "model") as model:
            if model.header["id"] != self.header["id"]:
                raise InputError("the model was replaced after this command started", where=str(self.path))
            return open_detector(model, sensor, self.constants, self.threshold, sticking=self.sticking)

    def require_dots(self, dot_xy_px: NDArray[np.float64]) -> None:
        """Raise InputError if the model is not for these dots, at rest at (rows, columns, 2)."""
        with StageFile(self.path, "model") as model:
            dots_for(model, dot_xy_px)


def _law(name: str, gain: float, margin: float) -> Law:
    """Return the built-in or plug-in law of a controller; InputError if it does not exist with this gain and margin."""
    own = plugins.find(plugins.CONTROLLERS, name, PluginLaw)
    try:
        return grip_control.make_law(name, gain, margin, own)
    except ValueError as error:
        where = "--controller" + ", --gain" * (gain != 1.0) + ", --grip-margin" * (margin != MARGIN)
        others = tuple(plugins.usable(plugins.CONTROLLERS))
        expected = ", or ".join((str(error).removeprefix("expected "), *others))
        known = (*grip_control.LAWS, *others)
        hint = "" if name in known else did_you_mean(name, known)
        raise InputError("unknown value", where=where, expected=expected, hint=hint) from None


@dataclass(frozen=True)
class GraspSettings:
    """Law, detector and timing of a series of grasps; detector: None for a law that uses none."""

    controller: str
    gain: float
    law: Law
    control_hz: float
    latency_ms: int
    lift_s: float
    balance_s: float
    detector: DetectorModel | None

    @classmethod
    def of(cls, params: Grasp) -> "GraspSettings":
        """Return the settings of the flags; InputError if the controller, its gain or the model does not exist.

        The paper's controllers have no default detector: with the pretrained one, they are not the paper's method.
        """
        law = _law(params.controller, params.gain, params.grip_margin)
        if isinstance(law, GripLaw) and params.model is None:
            raise InputError(
                f"--controller {params.controller} needs a slip detector",
                where="--model",
                expected="a model trained by the paper's recipe, or `shipped` for the pretrained one",
                hint=f"train the paper's: {TRAINS_PAPERS}; without --controller, evetac's own is used",
            )
        sticking = grip_control.uses_sticking(law)
        detector = DetectorModel.of(params, sticking=sticking) if grip_control.uses_detector(law) else None
        lasts_s = params.lift_s, params.balance_s
        return cls(params.controller, params.gain, law, params.control_hz, params.latency_ms, *lasts_s, detector)

    def timing(self, touch_s: float, lift_s: float | None = None, balance_s: float | None = None) -> Timing:
        """Return the phases and the controller timing, for a contact of this duration; None: as the flags say."""
        lasts_s = touch_s, self.lift_s if lift_s is None else lift_s, self.balance_s if balance_s is None else balance_s
        touch_ms, lift_ms, balance_ms = (round(SLICES_PER_S * each) for each in lasts_s)
        return Timing(touch_ms, lift_ms, balance_ms, self.control_hz, self.latency_ms)

    def open_detector(self, sensor: Mapping[str, Any]) -> OnlineSlipDetector | None:
        """Return the detector for a sensor with these datasets `sensor/...`; None for a law that uses none."""
        return None if self.detector is None else self.detector.open(sensor)

    def control(self) -> Control:
        """Return the controller at the beginning of a grasp."""
        return Control(self.law, self.control_hz, self.controller)

    def view(self, params: Grasp) -> ViewRequest | None:
        """Return how the trials are shown, if requested: with the grasp's detector, otherwise the pretrained one."""
        if not params.shown:
            return None
        if self.detector is None:
            return ViewRequest(preset=params.tracker)
        return ViewRequest(self.detector.path, self.detector.threshold, params.tracker)

    def parents(self) -> tuple[Header, ...]:
        """Return the header of the detector's model, if any, as parents of a recipe."""
        return () if self.detector is None else (self.detector.header,)

    def parameters(self, trial: Trial) -> dict[str, Any]:
        """Return the parameters of a grasp's recipe."""
        detector = self.detector
        tracking = None
        if detector is not None:
            tracking = {"preset": detector.preset, "constants": asdict(detector.constants)}
        return {
            **({} if trial.plan is None else trial.plan.parameters()),
            "trial": trial.number,
            "controller": self.controller,
            "gain": self.gain,
            "law": asdict(self.law),
            **({"law_method": self.law.method} if isinstance(self.law, PluginLaw) else {}),
            "latency_ms": self.latency_ms,
            "control_hz": self.control_hz,
            "tracker": tracking,
            "slip_threshold": None if detector is None else detector.threshold,
            "lift_s": self.lift_s,
            "balance_s": self.balance_s,
        }


@dataclass(frozen=True)
class SimulatedGrasp(SimulatedTrial):
    """A grasp in a simulated scene."""

    settings: GraspSettings
    timing: Timing


@dataclass(frozen=True)
class DeviceGrasp(DeviceTrial):
    """A grasp with devices in real time.

    driver: settings of the gripper's driver; watchdog_ms: as requested; most_s: longest duration; calibrations: of each
    camera's sensor, or none; armed: whether a real gripper may be moved.
    """

    settings: GraspSettings
    timing: Timing
    driver: "RhP12RnSettings"
    watchdog_ms: int
    most_s: float
    calibrations: tuple[Calibration, ...]
    armed: bool


@dataclass(frozen=True)
class ReplayGrasp(Trial):
    """A grasp on a recording, without motion; with two fingers, on those of both. timing: of a recorded grasp, its own.

    camera: replays the first recording.
    """

    camera: NamedCamera
    settings: GraspSettings
    timing: Timing
