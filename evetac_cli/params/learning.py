"""From recordings to slip and force: label, track, featurize, train, and the same of force."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.names import Prediction, Training
from evetac_cli.params.parameter import parameter

OTHERS, TRAINING = "Other methods than event-flow", "Training"  # panels of --help


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
        0.3,
        "Flow methods: relative flow of window against gel over the look-ahead that is slip.",
        unit="px",
        low=0.01,
        panel=OTHERS,
    )
    threshold_events: int = parameter(
        200, "Events of the window over the look-ahead that are slip; event-count.", unit="events", low=1, panel=OTHERS
    )
    look_ahead_ms: int = parameter(
        4,
        "Flow methods: flow is taken from a slice to the one this much later.",
        unit="ms",
        low=1,
        high=100,
        panel=OTHERS,
    )
    accumulate_ms: int = parameter(
        3, "Flow methods: slices summed into one event image.", unit="ms", low=1, high=100, panel=OTHERS
    )
    min_events: int = parameter(
        20,
        "Flow methods: window images with fewer events have no flow; their pair is left out.",
        unit="events",
        low=1,
        panel=OTHERS,
    )
    confirm_ms: int = parameter(
        5, "Slip must hold for this long to be an onset.", unit="ms", low=1, high=1000, panel=OTHERS
    )
    coarse_ms: int = parameter(
        5,
        "Step of the coarse search for the onset; up to --confirm-ms it misses none.",
        unit="ms",
        low=1,
        high=1000,
        panel=OTHERS,
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

    model: str | None = parameter(
        None,
        "Architecture, named as in the paper's table; -6x6: event images summed over 6 x 6 px, for a CPU;"
        " disp-xy: ours, which sees directions and changes of displacements; default: hist10, or that of --adapt.",
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
    horizon_ms: int | None = parameter(
        None,
        "Predict slip so far ahead: labels are shifted by as much; default: 0, or that of --adapt.",
        unit="ms",
        low=0,
        high=1000,
    )
    preset: str | None = parameter(
        None,
        "paper: SGD 0.001 on plain features; adam: Adam 0.001 on normalised features; adamw: AdamW 0.002 falling to 0"
        " on normalised features, samples made stronger and weaker, and the average of the weights over training;"
        " on simulated features it also learns, from the simulation's truth, which share of the contact slips."
        " Default: paper, or with --adapt, which takes no other, adamw with small steps.",
        choices=("paper", "adam", "adamw"),
    )
    epochs: int = parameter(70, "Passes over the non-slip slices with more than 25 events.", low=1, high=100000)
    max_steps: int | None = parameter(
        None,
        "Stop after this many steps, and say so; default: 40000, or 1000 with --adapt.",
        unit="steps",
        low=1,
    )
    patience: int | None = parameter(
        None,
        "Stop when the loss on the files that validate has not fallen for so many of 100 looks at it, evenly spread"
        " over the steps; its best network is then among the checkpoints. Default: take all steps.",
        low=1,
        high=100,
        panel=TRAINING,
        recipe=False,  # it is, where it is given: models that were made before there was such a choice stay up to date
    )
    seed: int = parameter(0, "Seed of weights, sampling and augmentation.", low=0, high=2**31 - 1)
    seeds: int = parameter(
        1, "Models to train, each with the next seed and in a file of its own.", low=1, high=1000, recipe=False
    )
    log: str | None = parameter(
        None,
        "tensorboard: write the losses while they fall to NAME.model.log. A CSV of them lies beside every model.",
        choices=("tensorboard",),
        panel=TRAINING,
        recipe=False,
    )
    device: str = parameter(
        "cpu", "Where it is computed; numbers depend on it.", choices=("cpu", "cuda"), panel=TRAINING
    )
    networks: int | None = parameter(
        None,
        "Train so many networks apart, from other first weights, and let the mean of their logits decide: steadier on"
        " objects and sensors unlike those learned from, at so many times the cost; default: 1, or as many as the model"
        " of --adapt.",
        low=1,
        high=32,
        panel=TRAINING,
    )
    objects: str = parameter(
        "", "Use the features of these objects only, as in `1-9` or `1-3,8`.", recipe=False, flag="--object"
    )
    validate: str = parameter(
        "",
        "Folder or glob of features to choose checkpoint and threshold on, at least 4; default: every 8th input.",
        recipe=False,
    )
    folds: int = parameter(
        0,
        "Choose checkpoint and threshold on objects that a network has not seen: this many more networks are trained,"
        " each without one share of the objects, and judged on that share. For detectors that will meet new objects.",
        low=0,
        high=100,
        panel=TRAINING,
    )
    adapt: str = parameter(
        "",
        "Go on from this trained model, or `shipped`, the package's: a few recordings of one's own sensor adapt it."
        " Architecture and horizon are the model's.",
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
        needs=(Training.PAPER, Training.GEL),
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
        needs=(Training.ADAPTATION,),
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its moduli, one standard deviation.",
        low=0.0,
        high=2.0,
        needs=(Training.SENSOR,),
    )
    contacts: int = parameter(
        4000, "Of method gel: contacts that are simulated.", low=10, high=1000000, needs=(Training.GEL,)
    )
    samples: int = parameter(
        200,
        "Of method paper: samples of each trajectory, evenly spread over the contact.",
        low=3,
        high=100000,
        needs=(Training.PAPER,),
    )
    noise_n: float = parameter(
        0.05,
        "Noise of the force sensor that is fitted to, sd; not of method gel.",
        unit="N",
        low=0.0,
        high=100.0,
        needs=(Training.PAPER, Training.ADAPTATION),
    )
    epochs: int = parameter(
        50,
        "Passes over the samples; of the paper's network the best on the last file is kept. Not with --adapt.",
        low=1,
        high=100000,
        needs=(Training.PAPER, Training.GEL),
    )
    seed: int = parameter(0, "Seed of the noise, the first weights and the order of samples.", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class PredictForce:
    """Predict force from tracked dots, slice by slice: shear, normal force and contact, with their uncertainty."""

    model: Path | None = parameter(
        None,
        "Force model, made by train-force, or `shipped`; default: the package's, which is for any sensor.",
        recipe=False,
    )
    sensor: str | None = parameter(
        None,
        "Your sensor's file as `evetac identify` writes it, or a sensor's name: its scale and stiffness; default:"
        " unknown, and forces are as unsure.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its moduli, one standard deviation.",
        low=0.0,
        high=2.0,
        needs=(Prediction.SENSOR,),
    )
