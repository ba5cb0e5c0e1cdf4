"""record: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.command import Command
from evetac_cli.commands.devices import DEVICES, Devices
from evetac_cli.commands.parameter import parameter
from evetac_cli.commands.trials import SCENE, SERIES, SIMULATED, VIEW, Trials
from evetac_cli.names import Capability

IMPORT = "Import"  # panel of --help
IMPORTED, RECORDED, MOVED, ADJUSTABLE = (
    (capability,) for capability in (Capability.IMPORT, Capability.RECORDED, Capability.MOVED, Capability.ADJUSTABLE)
)
READOUT_RATES = (
    *("constant-100", "constant-200", "constant-500", "constant-1000", "lossy-2000", "lossy-5000", "lossy-10000"),
    *("variable-2000", "variable-5000", "variable-10000", "variable-15000"),
)


@dataclass(frozen=True)
class Record(Devices, Trials):
    """Record events: simulate a scene, record from devices, or import a foreign event file."""

    scene: str = parameter(
        "slip",
        f"Scene: {', '.join(names.RECORDED_SCENES)}, or a TOML file.",
        needs=SIMULATED,
    )
    objects: str = parameter(
        "8",
        "Objects of the paper's table, 1 to 20, as in `8` or `1-3,10`; or a TOML file.",
        flag="--object",
        needs=SIMULATED,
    )
    tones: str | None = parameter(
        None,
        "Tones to play, of 1 to 2500, as in `200,300`; default: the scene's.",
        unit="Hz",
        flag="--tone",
        panel=SCENE,
        needs=(Capability.STEPPED,),
    )
    source: Path | None = parameter(
        None,
        f"Import this event file instead: {', '.join(names.IMPORTS.values())}, or of the format of a plug-in.",
        flag="--from",
        recipe=False,
    )
    frame_size: str | None = parameter(
        None,
        "Frame of the imported file where it does not say, as in 640x480; default: the smallest of a known sensor that"
        " holds all events.",
        unit="px",
        panel=IMPORT,
        needs=IMPORTED,
    )
    sort: bool = parameter(
        False,
        "Sort imported events by time, instead of refusing a file whose time goes back by 1 ms or more.",
        panel=IMPORT,
        needs=IMPORTED,
    )
    drop_late: bool = parameter(
        False,
        "Leave out imported events that come 1 ms or more after a later one, instead of refusing.",
        panel=IMPORT,
        needs=IMPORTED,
    )
    from_restart: int | None = parameter(
        None,
        "Of an imported file whose clock restarts, keep the part from this restart to the next; 0: before the first.",
        low=0,
        high=1000,
        panel=IMPORT,
        needs=IMPORTED,
    )
    stream: str | None = parameter(
        None,
        "Which event stream, topic, camera or array of the imported file, where it has several.",
        panel=IMPORT,
        needs=IMPORTED,
    )
    columns: str | None = parameter(
        None,
        "Order of four columns of the imported file that have no names, as in `x y t p`.",
        panel=IMPORT,
        needs=IMPORTED,
    )
    time_unit: str | None = parameter(
        None,
        "Unit of time of the imported text, numpy or HDF5 file, if it does not say: s, ms, us or ns; default: us"
        " if all times are whole, s otherwise.",
        choices=("s", "ms", "us", "ns"),
        panel=IMPORT,
        needs=IMPORTED,
    )
    frames: bool = parameter(
        False,
        "Keep the frames of the imported file, AEDAT4 or a bag, too; IMU samples and triggers are always kept.",
        panel=IMPORT,
        needs=IMPORTED,
    )
    seconds: float | None = parameter(
        None,
        "Record, or with --preview look, for so long, with --listen no longer than that (an hour unless named);"
        " default: until the gripper has let go, or Ctrl-C.",
        unit="s",
        low=0.001,
        high=86400.0,
        recipe=False,
        panel=DEVICES,
        needs=(Capability.DEVICE, Capability.PREVIEW),
    )
    closing_ma: int = parameter(
        10,
        "Current that closes the gripper until contact.",
        unit="mA",
        low=1,
        high=500,
        recipe=False,
        panel=DEVICES,
        needs=MOVED,
    )
    holding_ma: float | None = parameter(
        None,
        "Current that holds the object; default: what a virtual world asks for, 50 otherwise.",
        unit="mA",
        low=0.0,
        high=1000.0,
        recipe=False,
        panel=DEVICES,
        needs=MOVED,
    )
    hold_s: float = parameter(
        1.0,
        "How long it is held before the current falls.",
        unit="s",
        low=0.0,
        high=3600.0,
        recipe=False,
        panel=DEVICES,
        needs=MOVED,
    )
    lowest_ma: float = parameter(
        -50.0,
        "The recording ends where the current has fallen to this; less than --holding-ma.",
        unit="mA",
        low=-500.0,
        high=1000.0,
        recipe=False,
        panel=DEVICES,
        needs=MOVED,
    )
    current_of: str | None = parameter(
        None,
        "The gripper follows the current that this scene names (grip-steps, or a TOML file), instead of closing,"
        " holding and letting it fall.",
        recipe=False,
        panel=DEVICES,
        needs=MOVED,
    )
    threshold_on: int | None = parameter(
        None,
        "Contrast threshold of brighter, 0 most sensitive, 17 least; default: the driver's.",
        low=0,
        high=17,
        recipe=False,
        panel=DEVICES,
        needs=ADJUSTABLE,
    )
    threshold_off: int | None = parameter(
        None,
        "Contrast threshold of darker; default: the driver's.",
        low=0,
        high=17,
        recipe=False,
        panel=DEVICES,
        needs=ADJUSTABLE,
    )
    readout_rate: str | None = parameter(
        None,
        "Frames a second that the sensor reads out; default: variable-5000.",
        choices=READOUT_RATES,
        recipe=False,
        panel=DEVICES,
        needs=ADJUSTABLE,
    )
    expected_event_rate: float = parameter(
        1e6,
        "Events a second that the disk must have room for.",
        unit="1/s",
        low=0.0,
        high=1e9,
        recipe=False,
        panel=DEVICES,
        needs=RECORDED,
    )
    resume: bool = parameter(
        False,
        "Go on with a series, made with the same set-up.",
        recipe=False,
        panel=DEVICES,
        needs=RECORDED,
    )
    preview: bool = parameter(
        False,
        "Show what the camera sees; write and move nothing.",
        recipe=False,
        panel=VIEW,
        needs=SERIES,
    )

    @property
    def shown_in(self) -> str | None:
        """As of any trial; a preview is always shown."""
        return self.live_in if self.live or self.preview else None


COMMAND = Command(
    "record",
    Record,
    "trials.record",
    "",
    examples=(
        "evetac record --scene slip --object 1-3 --count 2 -o data",
        "evetac record --from events.aedat4",
        "evetac record --camera dvxplorer --gripper /dev/ttyUSB0 --arm --object 8",
    ),
)
