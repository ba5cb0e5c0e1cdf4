"""attach: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class Attach:
    """Add other streams of the trial, such as arm pose, forces or camera images, and write a new recording."""

    stream: list[str] | None = parameter(
        None,
        "NAME=FILE: name of the stream, and a CSV file, Parquet file or ROS 1 or ROS 2 bag with its data; for a bag,"
        " NAME=FILE:/TOPIC. Repeat the flag for more streams.",
        recipe=False,
    )
    offset: list[str] | None = parameter(
        None,
        "NAME=SECONDS: added to the times of a stream whose clock differs from that of the events; default: 0.",
        unit="s",
        recipe=False,
    )


COMMAND = Command(
    "attach",
    Attach,
    "stages.attach",
    "Recordings.",
    examples=(
        "evetac attach a.recording.h5 --stream arm=pose.csv --stream force=ft.parquet --offset arm=0.012",
        "evetac attach a.recording.h5 --stream wrist=trial.mcap:/wrist/image_raw -o b.recording.h5",
    ),
)
