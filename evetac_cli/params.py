"""Parameters of all commands: one frozen dataclass each, from which flags, config file and header are made.

A field says its default, help, unit and range once. Fields with `recipe=False` choose files or how to run; they do not
change the numbers and are not part of a recipe.
"""

import dataclasses
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any


def parameter(
    default: Any,
    help_: str,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
    low: float | None = None,
    high: float | None = None,
    recipe: bool = True,
    flag: str = "",
) -> Any:
    """A dataclass field that knows its help text, unit and range (both ends included)."""
    about = {"help": help_, "unit": unit, "choices": choices, "low": low, "high": high, "recipe": recipe, "flag": flag}
    return field(default=default, metadata=about)


READOUT_RATES = (
    *("constant-100", "constant-200", "constant-500", "constant-1000", "lossy-2000", "lossy-5000", "lossy-10000"),
    *("variable-2000", "variable-5000", "variable-10000", "variable-15000"),
)


SOLVER_OPTIONS = ("tolerance_um", "step_ms", "theta", "node_pitch_mm", "camera_substeps", "scans_per_ms")


@dataclass(frozen=True)
class Trials:
    """Trials to simulate: what `record` and `grasp` have in common."""

    scene: str
    objects: str
    count: int = parameter(1, "Trials of each object.", low=1, high=100000, recipe=False)
    seed: int = parameter(0, "Seed of everything that is drawn.", low=0, high=2**31 - 1)
    sensor: str = parameter(
        "evetac",
        "Sensor: evetac, second, bare-dvxplorer, soft-gel, stiff-gel, realistic; randomized: another one, and another"
        " gripper, for every trial; randomized:N: the N-th of these, the same wherever it is named; or a TOML file, as"
        " `evetac identify` writes one.",
    )
    gel: str | None = parameter(None, "Gel of the sensor, instead of the scene's.", choices=("cut", "closed"))
    texture: str | None = parameter(
        None, "Whether the window shows the object's texture, instead of what the scene says.", choices=("on", "off")
    )
    readout: str = parameter(
        "dvxplorer", "Camera: scanned 5000 times a second, or every event to the us.", choices=("dvxplorer", "ideal")
    )
    tolerance_um: float | None = parameter(
        None,
        "Largest estimated error of the displacement in one mechanical step; default: the scene's, or 0.2.",
        unit="um",
        low=0.001,
        high=1000.0,
        flag="--tolerance",
    )
    step_ms: float | None = parameter(
        None, "Fixed mechanical step instead, 1 divided by a whole number.", unit="ms", low=0.0001, high=1.0
    )
    theta: float | None = parameter(
        None, "Of the mechanical step: 1 is implicit Euler, 0.5 the trapezoidal rule; default: 0.55.", low=0.5, high=1.0
    )
    node_pitch_mm: float | None = parameter(
        None, "Distance of the gel's nodes; default: the scene's, or 0.833.", unit="mm", low=0.05, high=5.0
    )
    camera_substeps: int | None = parameter(
        None, "Straight pieces of a dot's path in each ms; default: the scene's, or 1.", low=1, high=100
    )
    scans_per_ms: int | None = parameter(
        None, "Scans of the simulated readout; default: the scene's, or 5.", unit="1/ms", low=1, high=100
    )
    dry_run: bool = parameter(False, "Show what would be built, left out and paid; write nothing.", recipe=False)

    def solver(self) -> dict[str, Any]:
        """The settings of the simulation that were given."""
        named = {name: getattr(self, name) for name in SOLVER_OPTIONS}
        return {name: value for name, value in named.items() if value is not None}


@dataclass(frozen=True)
class Record(Trials):
    """Record events: simulate a scene, record from devices, or import a foreign event file."""

    scene: str = parameter(
        "slip",
        "Scene: slip, slip-varied, handling, data-rate, grip-steps, shear, press, rest, edge, vibration,"
        " vibration-randomized, or a TOML file.",
    )
    objects: str = parameter("8", "Objects of the paper's table, 1 to 20, as in `8` or `1-3,10`.", flag="--object")
    tones: str | None = parameter(
        None, "Tones to play, of 1 to 2500, as in `200,300`; default: the scene's.", unit="Hz", flag="--tone"
    )
    source: Path | None = parameter(
        None,
        "Import this event file instead of simulating: AEDAT4, DSEC HDF5, text `t x y p`, Prophesee RAW or DAT, or a"
        " bag of ROS 1 or ROS 2 (its folder).",
        flag="--from",
        recipe=False,
    )
    frame_size: str | None = parameter(
        None, "Frame of the imported file where it does not say, as in 640x480.", unit="px"
    )
    sort: bool = parameter(False, "Sort imported events whose time goes backwards, instead of refusing them.")
    stream: str | None = parameter(None, "Which event stream, or topic, of the imported file, where it has several.")
    calibration: Path | None = parameter(
        None, "Dot grid (JSON) to store with a recording that is imported or from a device.", recipe=False
    )
    camera: str = parameter(
        "sim",
        "Camera: sim; virtual, a simulated world behind the real driver, with faults as in virtual:unplug@2 (README,"
        " Hardware, lists them);"
        " dvxplorer or dvxplorer:SERIAL; dv or dv:SERIAL, through dv-processing; replay:FILE.",
        recipe=False,
    )
    gripper: str | None = parameter(
        None,
        "Gripper: sim; virtual, with faults as in virtual:overload@1+lost-answer%2 (late-answer, lost-answer, bad-crc,"
        " watchdog, overload, unplug; @SECONDS after torque first went on); none; or its PORT or PORT@BAUD; default:"
        " that of the camera, or none.",
        recipe=False,
    )
    seconds: float | None = parameter(
        None,
        "Devices and --live: record, or look, for so long; default: until the gripper has let go, or Ctrl-C.",
        unit="s",
        low=0.001,
        high=86400.0,
        recipe=False,
    )
    arm: bool = parameter(
        False,
        "Devices: move a real gripper. Torque is switched off at the end, and whenever something fails: what is held"
        " then falls.",
        recipe=False,
    )
    closing_ma: int = parameter(
        10, "Devices: current that closes the gripper until contact.", unit="mA", low=1, high=500, recipe=False
    )
    holding_ma: float | None = parameter(
        None,
        "Devices: current that holds the object; default: what a virtual world asks for, 50 otherwise.",
        unit="mA",
        low=0.0,
        high=1000.0,
        recipe=False,
    )
    hold_s: float = parameter(
        1.0, "Devices: how long it is held before the current falls.", unit="s", low=0.0, high=3600.0, recipe=False
    )
    lowest_ma: float = parameter(
        -50.0,
        "Devices: the recording ends where the current has fallen to this; less than --holding-ma.",
        unit="mA",
        low=-500.0,
        high=1000.0,
        recipe=False,
    )
    current_of: str | None = parameter(
        None,
        "Devices: the gripper follows the current that this scene names (grip-steps, or a TOML file), instead of"
        " closing, holding and letting it fall.",
        recipe=False,
    )
    watchdog_ms: int = parameter(
        100,
        "Devices: the gripper lets go if it gets no command for so long, or nobody records; a multiple of 20.",
        unit="ms",
        low=20,
        high=500,
        recipe=False,
    )
    threshold_on: int | None = parameter(
        None,
        "Devices: contrast threshold of brighter, 0 most sensitive, 17 least; default: the driver's.",
        low=0,
        high=17,
        recipe=False,
    )
    threshold_off: int | None = parameter(
        None, "Devices: ... of darker; default: the driver's.", low=0, high=17, recipe=False
    )
    readout_rate: str | None = parameter(
        None,
        "Devices: frames a second that the sensor reads out; default: variable-5000.",
        choices=READOUT_RATES,
        recipe=False,
    )
    expected_event_rate: float = parameter(
        1e6, "Devices: events a second that the disk must have room for.", unit="1/s", low=0.0, high=1e9, recipe=False
    )
    resume: bool = parameter(False, "Devices: go on with a series, made with the same set-up.", recipe=False)
    live: bool = parameter(False, "Show what the camera sees, and write nothing.", recipe=False)


@dataclass(frozen=True)
class Trim:
    """Cut a range of slices out of a recording, as a recording of its own."""

    from_ms: int = parameter(0, "First slice of the piece.", unit="ms", low=0)
    to_ms: int | None = parameter(None, "Slice after its last; default: the end.", unit="ms", low=1)


@dataclass(frozen=True)
class Calibrate:
    """Find the dot grid of a gel in a press recording, or import it, and write it as JSON for --calibration."""

    refine: Path | None = parameter(
        None, "Start from this default grid (JSON); dots that were not pressed keep its places.", recipe=False
    )
    source: Path | None = parameter(
        None,
        "Import this instead: the official software's pickle, which is not executed, or JSON.",
        flag="--import",
        recipe=False,
    )
    gel: str | None = parameter(
        None, "What the gel is; default: as its columns say, 9 or 8, or the default grid.", choices=("cut", "closed")
    )
    any_grid: bool = parameter(False, "Take dots that are not the whole grid of an Evetac, also those in no grid.")


@dataclass(frozen=True)
class Identify:
    """Estimate a sensor from recordings (at rest, pressed, gripping); write it as TOML for --sensor, with intervals."""

    like: str = parameter("evetac", "The sensor that has all which the recordings do not tell.")
    name: str = parameter("own-sensor", "What recordings made with it call the sensor.")
    seed: int = parameter(0, "Seed of the bootstrap intervals.", low=0, high=2**31 - 1)
    object_mass_g: float | None = parameter(
        None, "Mass of the object that a gripper held: the scale of the gel's stiffness.", unit="g", low=1.0, high=1e5
    )
    object_friction: float = parameter(
        0.9, "Static friction of that object on the gel of an average sensor; 0.9 is glass.", low=0.01, high=10.0
    )
    force_per_current: float | None = parameter(
        None,
        "Force of a finger for each mA of the gripper's current, by a scale between the fingers; it makes forces out of"
        " what recordings tell in current.",
        unit="N/mA",
        low=0.001,
        high=100.0,
    )
    pixel_mm: float | None = parameter(
        None,
        "Size of a pixel on the gel, by a ruler laid on it; default: that of --like, taken as known within 12 %.",
        unit="mm",
        low=0.001,
        high=1.0,
    )


@dataclass(frozen=True)
class Label:
    """Label when the object slips, from what the window shows against the gel."""

    method: str = parameter(
        "event-flow",
        "How; event-flow: motion counted from events; farneback: the paper's optical flow; dis: another flow;"
        " event-count: many events in the window; truth: gross slip as the simulation knows it, for comparison.",
        choices=("event-flow", "farneback", "dis", "event-count", "truth"),
    )
    slip_distance_px: float = parameter(
        0.3, "Slide of the object on the gel that is the onset of slip; event-flow.", unit="px", low=0.01
    )
    edge_events: float = parameter(
        6.9, "Thresholds that a pixel crosses when a dot's rim passes; event-flow.", unit="events", low=0.1
    )
    threshold_px: float = parameter(
        0.3, "Flow methods: relative flow of window against gel over the look-ahead that is slip.", unit="px", low=0.0
    )
    threshold_events: int = parameter(
        200, "Events of the window over the look-ahead that are slip; event-count.", unit="events", low=1
    )
    look_ahead_ms: int = parameter(
        4, "Flow methods: flow is taken from a slice to the one this much later.", unit="ms", low=1, high=100
    )
    accumulate_ms: int = parameter(3, "Flow methods: slices summed into one event image.", unit="ms", low=1, high=100)
    min_events: int = parameter(
        20, "Flow methods: window images with fewer events have no flow; their pair is left out.", unit="events", low=1
    )
    confirm_ms: int = parameter(
        5, "All but event-flow: slip must hold for this long to be an onset.", unit="ms", low=1, high=1000
    )
    coarse_ms: int = parameter(
        5,
        "All but event-flow: step of the coarse search for the onset; up to confirm_ms it misses none.",
        unit="ms",
        low=1,
        high=1000,
    )
    after_ms: int = parameter(60, "Slices labelled after the onset; later ones are not examined.", unit="ms", low=0)
    from_start: bool = parameter(
        False, "Label closing, loading and light contact too, before the current falls; truth, to train on."
    )


@dataclass(frozen=True)
class Track:
    """Track the dots of the gel, slice by slice."""

    preset: str = parameter(
        "stable",
        "Tracker; stable: ours; paper; official: the authors' published code; unregularised: paper's without grid.",
        choices=("stable", "paper", "official", "unregularised"),
    )
    step_size: float | None = parameter(None, "Gradient step alpha; overrides the preset.", low=0.0)
    regulariser: float | None = parameter(None, "Weight of the distance regulariser; overrides the preset.", low=0.0)
    min_events: int | None = parameter(
        None, "A dot moves only with more events than this; overrides the preset.", unit="events", low=0
    )
    calibration: Path | None = parameter(
        None, "Dot grid (JSON) to use instead of the one in the recording.", recipe=False
    )


@dataclass(frozen=True)
class Featurize:
    """Turn a recording and its tracks (and labels) into features for slip detection."""

    tracks: Path | None = parameter(
        None, "Tracks of the recording, or their folder; default: beside it, under the same name.", recipe=False
    )
    labels: Path | None = parameter(
        None,
        "Labels of the recording, or their folder; default: beside it, under the same name, where there are any.",
        recipe=False,
    )
    images: bool = parameter(False, "Add event images, for the image baselines no-hist-img and hist10-img.")


@dataclass(frozen=True)
class Train:
    """Train a slip detector on labelled features."""

    model: str = parameter(
        "hist10",
        "Architecture, named as in the paper's table; -6x6: event images summed over 6 x 6 px, for a CPU;"
        " disp-xy: ours, which sees directions and changes of displacements.",
        choices=(
            "no-hist",
            "hist10",
            "events-only",
            "disp-only",
            "hist20",
            "down5",
            "fast-slow",
            "no-hist-img",
            "hist10-img",
            "no-hist-img-6x6",
            "hist10-img-6x6",
            "disp-xy",
        ),
    )
    horizon_ms: int = parameter(
        0, "Predict slip so far ahead: labels are shifted by as much.", unit="ms", low=0, high=1000
    )
    preset: str = parameter(
        "paper",
        "paper: SGD 0.001 on plain features; adam: Adam 0.001 on normalised features; adamw: AdamW 0.002 falling to 0"
        " on normalised features, samples made stronger and weaker, and the average of the weights over training;"
        " adapt: the same at a tenth of the rate, for --adapt.",
        choices=("paper", "adam", "adamw", "adapt"),
    )
    epochs: int = parameter(70, "Passes over the non-slip slices with more than 25 events.", low=1, high=100000)
    max_steps: int = parameter(40000, "Stop after this many steps, and say so.", unit="steps", low=1)
    seed: int = parameter(0, "Seed of weights, sampling and augmentation.", low=0, high=2**31 - 1)
    seeds: int = parameter(
        1, "Models to train, each with the next seed and in a file of its own.", low=1, high=1000, recipe=False
    )
    device: str = parameter("cpu", "Where it is computed; numbers depend on it.", choices=("cpu", "cuda"))
    objects: str = parameter(
        "", "Use the features of these objects only, as in `1-9` or `1-3,8`.", recipe=False, flag="--object"
    )
    validate: str = parameter(
        "",
        "Folder or glob of features on which checkpoint and threshold are chosen; default: every 8th input.",
        recipe=False,
    )
    folds: int = parameter(
        0,
        "Choose checkpoint and threshold on objects that a network has not seen: this many more networks are trained,"
        " each without one share of the objects, and judged on that share. For detectors that will meet new objects.",
        low=0,
        high=100,
    )
    adapt: str = parameter(
        "",
        "Go on from this trained model, or `shipped`, the package's: a few recordings of one's own sensor adapt it."
        " Architecture and horizon are the model's; 1000 small steps unless --max-steps says otherwise.",
        recipe=False,
    )


@dataclass(frozen=True)
class TrackRgb:
    """Track the dots as an RGB sensor at 25 Hz sees them, by optical flow: a comparison (simulated recordings)."""

    seed: int = parameter(0, "Seed of the frames' noise.", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class TrainForce:
    """Train a force model: the paper's on dots of one sensor, or one for any sensor; adapt the latter to your own."""

    method: str = parameter(
        "paper",
        "paper: shear force by a linear regression and the paper's network, for the dot grid of one sensor; gel: shear"
        " and normal force and contact for any dot grid and gel, from simulated contacts, its errors measured on the"
        " files.",
        choices=("paper", "gel"),
    )
    adapt: str = parameter(
        "",
        "Go on from this model of method gel, or `shipped`, the package's: recordings of your sensor under known forces"
        " adapt it. Readings lie beside the tracks as NAME.force.csv, or are the truth of a simulation.",
        recipe=False,
    )
    sensor: str | None = parameter(
        None,
        "With --adapt: your sensor's file as `evetac identify` writes it, or a sensor's name; default: unknown.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1, "With --sensor: relative error of its moduli, one standard deviation.", low=0.0, high=2.0
    )
    contacts: int = parameter(4000, "Of method gel: contacts that are simulated.", low=10, high=1000000)
    samples: int = parameter(
        200, "Of method paper: samples of each trajectory, evenly spread over the contact.", low=3, high=100000
    )
    noise_n: float = parameter(
        0.05, "Noise of the force sensor that is fitted to, sd; not of method gel.", unit="N", low=0.0, high=100.0
    )
    epochs: int = parameter(
        50,
        "Passes over the samples; of the paper's network the best on the last file is kept. Not with --adapt.",
        low=1,
        high=100000,
    )
    seed: int = parameter(0, "Seed of the noise, the first weights and the order of samples.", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class PredictForce:
    """Predict force from tracked dots, slice by slice: shear, normal force and contact, with their uncertainty."""

    model: Path | None = parameter(
        None, "Force model, made by train-force; default: the one for any sensor that evetac has.", recipe=False
    )
    sensor: str | None = parameter(
        None,
        "Your sensor's file as `evetac identify` writes it, or a sensor's name: its scale and stiffness; default:"
        " unknown, and forces are as unsure.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1, "With --sensor: relative error of its moduli, one standard deviation.", low=0.0, high=2.0
    )


@dataclass(frozen=True)
class EvaluateSlip:
    """Measure slip timing and F1 of models on trajectories they never saw."""

    model: Path | None = parameter(
        None, "Model file, a folder of them, or a glob; the others of several stand among the files.", recipe=False
    )
    threshold: float | None = parameter(None, "Use this threshold instead of each model's own.", low=0.0, high=1.0)


@dataclass(frozen=True)
class EvaluateDataRate:
    """Compare the bytes a second of recordings with those of an RGB sensor: whole, in contact, and about slip."""

    event_bytes: int = parameter(5, "Size of an event: x, y and polarity.", unit="bytes", low=1, high=64)
    rgb_frame: str = parameter("540x480x3", "Frame of the RGB sensor: width, height, bytes a pixel.")
    rgb_hz: float = parameter(25.0, "Frames a second of the RGB sensor.", unit="Hz", low=0.001, high=1e6)
    around_s: float = parameter(0.5, "How long about the onset is about slip, half of it before.", unit="s", low=0.002)


@dataclass(frozen=True)
class EvaluateVibration:
    """Estimate the frequency at which the gel vibrates, and how often windows of several lengths get it right."""

    preset: str = parameter(
        "default",
        "default: how far the gel moves at each frequency, and the paper's method beside it; paper: only the strongest"
        " line in the number of events a slice.",
        choices=("default", "paper"),
    )
    windows: str = parameter("10,2,1", "Lengths of windows, 0.1 to 10.", unit="s")
    true_hz: float | None = parameter(
        None, "The tone that was played; default: the truth of a simulation.", unit="Hz", low=0.1, high=1e6
    )
    tolerance_hz: float = parameter(
        1.0,
        "A frequency so near to the tone is right; at least 0.5 over the window's length, 2 Hz in 0.25 s.",
        unit="Hz",
        low=0.0,
        high=1e3,
    )
    lowest_hz: float = parameter(25.0, "Lower frequencies are left out.", unit="Hz", low=1.0, high=1e4)
    rate: int = parameter(
        1000, "Frequencies up to half of this; events are counted so often a second.", unit="Hz", low=100, high=20000
    )
    false_alarms: float = parameter(
        0.01, "Probability that noise alone is taken for a vibration; default preset.", low=1e-9, high=0.5
    )


@dataclass(frozen=True)
class EvaluateRealism:
    """Compare a simulated recording with a real one: rates, intervals, dot edges, if they can be told apart."""

    same: Path | None = parameter(
        None, "Another recording of the real sensor, with the same motion: how well two of one can be told apart.",
        recipe=False,
    )  # fmt: skip


@dataclass(frozen=True)
class EvaluateLabels:
    """Compare the onset of labels with the true onset of gross slip (simulated recordings)."""


@dataclass(frozen=True)
class EvaluateTracking:
    """Measure whether dots end where they began, and how far from the truth they were (simulated recordings)."""

    recordings: Path | None = parameter(
        None, "Folder of the recordings, if they do not lie beside the tracks.", recipe=False
    )


@dataclass(frozen=True)
class EvaluateGrasp:
    """Report the outcome of grasps: lifted, balanced, moved (simulated recordings)."""


@dataclass(frozen=True)
class EvaluateCost:
    """Measure error against run time of a part's numerical choices: table, report, plot."""

    part: str = parameter(
        "sim",
        "What is measured; sim: the simulator; pipeline: settings of a recording, at the end of the whole chain; label:"
        " slip labels; track: the dot tracker; model: slip detectors; grasp: grasps with a late detector, a slow"
        " controller, other detectors; scenes: what the parts of three scenes cost a slice, each scene with and without"
        " them.",
        choices=("sim", "pipeline", "label", "track", "model", "grasp", "scenes"),
        flag="PART",
    )
    model: Path | None = parameter(
        None,
        "Part model: model file, a folder of them, or a glob, beside the report of `evaluate slip` on them; without:"
        " untrained ones. Part grasp: detectors to try beside the package's.",
        recipe=False,
    )
    trials: int | None = parameter(
        None,
        "Trials of each setting, where they are simulated; default: as many as fit into three minutes.",
        low=1,
        high=10000,
    )
    seed: int = parameter(
        10000,
        "Seed of the first trial; no constant was chosen on seeds from 10,000 on.",
        low=0,
        high=2**31 - 1 - 10000,
    )
    full: bool = parameter(False, "More settings, finer references, more trials; takes many minutes.")


@dataclass(frozen=True)
class EvaluateStability:
    """Run the stiff, extreme and nonsensical cases of a part: within stated bounds, or refused in words."""

    part: str = parameter(
        "sim",
        "What is tried; sim: the simulator; track: the dot tracker; grasp: the loop of detector, controller, gripper.",
        choices=("sim", "track", "grasp"),
        flag="PART",
    )
    seed: int = parameter(0, "Seed of the cases that are drawn.", low=0, high=2**31 - 1)
    full: bool = parameter(False, "More settings, longer runs and many more random cases; takes a few minutes.")
    strict: bool = parameter(
        False, "Exit with 1 where a case is not ok; without, what is not ok is printed and counted.", recipe=False
    )


@dataclass(frozen=True)
class EvaluateForce:
    """Compare the forces that force models predict from dots with the true ones (simulated recordings)."""

    model: str = parameter(
        "", "Force model, folder or glob of several: each judges the tracks of its own sensor.", recipe=False
    )
    adapt_on: str = parameter(
        "",
        "Tracks (a folder or a glob) of the same sensors, on which a model of method gel is adapted first; one row"
        " more of each sensor.",
        recipe=False,
    )
    identified: str = parameter(
        "",
        "Folder with files of the same sensors by `evetac identify`, 7.sensor.toml for randomized:7: one row more, of"
        " method gel, of each sensor that has one.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1, "Of method gel: relative error of the moduli that are taken as known, sd.", low=0.0, high=2.0
    )
    samples: int = parameter(200, "Samples of each trajectory, evenly spread over the contact.", low=3, high=100000)
    noise_n: float = parameter(
        0.05, "Noise of the force sensor that is compared with, sd.", unit="N", low=0.0, high=100.0
    )
    seed: int = parameter(0, "Seed of the noise, and of the error of the moduli.", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class Grasp(Trials):
    """Lift an object with slip feedback: detect slip at 1000 Hz, control the gripper at 500 Hz."""

    scene: str = parameter("lift", "Scene: lift, sideways, drop-20g, drop-100g, or a TOML file.")
    objects: str = parameter("11", "Objects of the paper's table, 1 to 20, as in `11` or `10-18`.", flag="--object")
    model: Path | None = parameter(
        None, "Model file of the slip detector; default: the package's, disp-xy 10 ms ahead.", recipe=False
    )
    slip_threshold: float = parameter(
        0.8,
        "Probability from which on the controller is told of slip. Lower than the package's detector's own, which is"
        " chosen for timing: a grip is best tightened while the contact begins to slip.",
        low=0.0,
        high=1.0,
    )
    controller: str = parameter(
        "paper",
        "Law of the grip; paper: the paper's, whose balance sets its reference at the first slip; paper-reset: at every"
        " slip; load-proportional: ours, in proportion to the load; none: contact alone, without the detector; fixed:N:"
        " closed N ticks beyond light contact.",
    )
    gain: float = parameter(
        1.0, "K_p in balance, in multiples of the paper's; paper and paper-reset.", low=0.01, high=100.0
    )
    latency_ms: int = parameter(0, "The slip signal reaches the controller so much later.", unit="ms", low=0, high=1000)
    control_hz: float = parameter(
        500.0, "Steps of the controller a second; 1000 has to be a multiple.", unit="Hz", low=1.0, high=1000.0
    )
    tracker: str = parameter(
        "stable", "Preset of the dot tracker.", choices=("stable", "paper", "official", "unregularised")
    )
    lift_s: float = parameter(10.0, "Duration of the lifting phase.", unit="s", low=1.0, high=600.0)
    balance_s: float = parameter(20.0, "Duration of the balancing phase.", unit="s", low=0.0, high=600.0)
    camera: str = parameter(
        "sim",
        "Camera: sim; virtual (a simulated world behind the real driver, in real time); dvxplorer, dvxplorer:SERIAL;"
        " dv, dv:SERIAL; replay:RECORDING, with --gripper sim what the controller would have done.",
        recipe=False,
    )
    gripper: str | None = parameter(
        None,
        "Gripper: sim; virtual, with faults as in virtual:overload@1 (README, Hardware, lists them); or its PORT or"
        " PORT@BAUD; default: that of the camera.",
        recipe=False,
    )
    calibration: Path | None = parameter(
        None, "Devices: dot grid (JSON) of the sensor; default: what a virtual world says.", recipe=False
    )
    arm: bool = parameter(
        False,
        "Devices: move a real gripper. Torque is switched off at the end, and at once if the detector, the camera or"
        " the bus fails: what is held then falls.",
        recipe=False,
    )
    max_current_ma: int = parameter(
        100, "Devices: the gripper's motor current never exceeds this.", unit="mA", low=1, high=2000, recipe=False
    )
    max_seconds: float = parameter(
        60.0, "Devices: no grasp takes longer.", unit="s", low=1.0, high=3600.0, recipe=False
    )
    watchdog_ms: int = parameter(
        60,
        "Devices: torque is switched off if detector, camera or computer are silent for so long; a multiple of 20.",
        unit="ms",
        low=20,
        high=500,
        recipe=False,
    )


@dataclass(frozen=True)
class View:
    """Look at a recording and what was computed from it: one HTML page that needs no network; an animation too."""

    start_s: float = parameter(0.0, "Show from here on.", unit="s", low=0.0, recipe=False)
    stop_s: float | None = parameter(None, "Show up to here; default: the end.", unit="s", low=0.0, recipe=False)
    shown_ms: int = parameter(5, "Events summed into one image.", unit="ms", low=1, high=1000, recipe=False)
    images: int = parameter(
        500, "Images in the page at most, dense near slip and where it is busiest.", low=1, high=3000, recipe=False
    )
    film: Path | None = parameter(None, "Write an animation too, to this GIF.", recipe=False)


@dataclass(frozen=True)
class Export:
    """Write the events, or the dot grid, of recordings in a format that other programs read."""

    format: str = parameter(
        "aedat4",
        "aedat4: for DV and dv-processing; dsec: HDF5 as in the DSEC data set; text: `t_us x y p` a line;"
        " calibration: the dot grid as JSON, or with -o NAME.pkl as the official software's pickle.",
        choices=("aedat4", "dsec", "text", "calibration"),
        recipe=False,
    )


@dataclass(frozen=True)
class Doctor:
    """Find cameras and grippers, and say of each what is wrong and the command that mends it; changes nothing.

    Ends with 0 if all that was found is fine, or nothing was found, and with 3 if something is wrong. With --hardware
    it tries a camera and a gripper step by step, moves the fingers a little, and writes a report.
    """

    print_udev: bool = parameter(False, "Print udev rules and where to put them, and do nothing else.", recipe=False)
    gripper: str | None = parameter(
        None,
        "Examine this port too, with or without @BAUD. By itself it only talks to ports of FTDI adapters (U2D2).",
        recipe=False,
    )
    hardware: bool = parameter(
        False,
        "First contact: try --camera and --gripper step by step, with at most 20 mA; stops, torque off, at the first"
        " step that is not as expected.",
        recipe=False,
    )
    camera: str | None = parameter(
        None, "--hardware: camera to try: dvxplorer, dvxplorer:SERIAL, dv, dv:SERIAL, or virtual.", recipe=False
    )
    arm: bool = parameter(False, "--hardware: move a real gripper.", recipe=False)
    yes: bool = parameter(False, "--hardware: do not ask before the fingers move.", recipe=False)


def recipe_of(params: Any) -> dict[str, Any]:
    """The parameters that determine the numbers, for a header."""
    return {item.name: getattr(params, item.name) for item in fields(params) if item.metadata["recipe"]}


def flag_of(item: "dataclasses.Field[Any]") -> str:
    """The long flag of a field: --step-size for step_size; without dashes it is a positional argument."""
    return str(item.metadata["flag"]) or "--" + item.name.replace("_", "-")
