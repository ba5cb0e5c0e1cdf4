"""predict-touch: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import Command, parameter
from evetac_cli.names import TouchOption

OF_A_GEL = (TouchOption.OF_NO_MODEL, TouchOption.TOUCH)


@dataclass(frozen=True)
class GelFlags:
    """What is known of a gel, for predict-touch without --model and for train-force --method touch."""

    sensor: str | None = parameter(
        None,
        "Your sensor's file, as written by `evetac identify`, or the name of a sensor, for its scale, stiffness and"
        " creep; default: unknown sensor, which makes forces less certain.",
        recipe=False,
        needs=OF_A_GEL,
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its shear modulus (one standard deviation).",
        low=0.0,
        high=2.0,
        needs=(TouchOption.SENSOR,),
    )
    height_mm: float = parameter(4.0, "Thickness of the gel.", unit="mm", low=0.1, high=100.0, needs=OF_A_GEL)
    print_depth_mm: float = parameter(
        0.0, "Depth of the dots below the surface.", unit="mm", low=0.0, high=99.0, needs=OF_A_GEL
    )
    lens_mm: float = parameter(
        25.0,
        "Distance from the lens to the dots, to correct for pressed dots that appear farther from the axis.",
        unit="mm",
        low=1.0,
        high=1e6,
        needs=OF_A_GEL,
    )
    gel_mm: str = parameter(
        "",
        "Left, top, right and bottom edge of the gel, measured from the middle of the frame, e.g. -12.8,-7.5,10.5,7.5;"
        " default: those of --sensor. Without --sensor, edges are taken to be far away, except at the window of a cut"
        " gel.",
        unit="mm",
        needs=OF_A_GEL,
    )


@dataclass(frozen=True)
class PredictTouch(GelFlags):
    """Estimate where the gel is touched, how hard and in which direction, in each slice, from tracked dots.

    Leave out the flags of the gel with --model, which stores them.
    """

    model: Path | None = parameter(
        None,
        "Scale of your sensor, trained by `train-force --method touch` on known forces.",
        recipe=False,
    )
    map_every: int = parameter(
        10,
        "Interval at which maps of shear and pressure are stored; 0: no maps, for small files.",
        unit="ms",
        low=0,
        high=1000000,
    )
    leave_out_wrong: bool = parameter(
        False,
        "Leave out dots whose motion is inconsistent with the others. Use it after minutes of pushes; otherwise"
        " estimates get slightly worse.",
    )


COMMAND = Command(
    "predict-touch",
    PredictTouch,
    "stages.touch.predict_touch",
    "Tracks.",
    kind="tracks",
    examples=(
        "evetac predict-touch data/*.tracks.h5 --sensor mine.sensor.toml",
        "evetac predict-touch data --model own.force-model.h5 --map-every 0",
    ),
)
