"""predict-touch: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter
from evetac_cli.names import TouchOption


@dataclass(frozen=True)
class PredictTouch:
    """Tell where the gel is touched, how hard and in which direction, slice by slice, from tracked dots."""

    sensor: str | None = parameter(
        None,
        "Your sensor's file as `evetac identify` writes it, or a sensor's name: its scale, stiffness and creep;"
        " default: unknown, and forces are as unsure.",
        recipe=False,
    )
    model: Path | None = parameter(
        None,
        "Your sensor's own scale, made by `train-force --method touch` from known forces.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its shear modulus, one standard deviation.",
        low=0.0,
        high=2.0,
        needs=(TouchOption.SENSOR,),
    )
    map_every: int = parameter(
        10, "Store maps of shear and pressure so often; 0: no maps, and small files.", unit="ms", low=0, high=1000000
    )
    height_mm: float = parameter(
        4.0, "Thickness of the gel; --model knows it.", unit="mm", low=0.1, high=100.0, needs=(TouchOption.OF_NO_MODEL,)
    )
    print_depth_mm: float = parameter(
        0.0,
        "Depth of the dots under the surface; --model knows it.",
        unit="mm",
        low=0.0,
        high=99.0,
        needs=(TouchOption.OF_NO_MODEL,),
    )
    lens_mm: float = parameter(
        25.0,
        "From the lens to the dots, which are seen farther from the axis when pressed; --model knows it.",
        unit="mm",
        low=1.0,
        high=1e6,
        needs=(TouchOption.OF_NO_MODEL,),
    )
    gel_mm: str = parameter(
        "",
        "Where the gel ends: left, top, right and bottom edge from the middle of the frame, as in -12.8,-7.5,10.5,7.5;"
        " default: a named sensor's, else far away but for the window of a cut gel; --model knows it.",
        unit="mm",
        needs=(TouchOption.OF_NO_MODEL,),
    )
    leave_out_wrong: bool = parameter(
        False,
        "Leave out dots that moved otherwise than the others allow: better after minutes of pushes, else a bit worse.",
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
