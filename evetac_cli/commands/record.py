"""record: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import EXPERTS, Command, parameter
from evetac_cli.commands.trials import DEVICES, SCENE, SERIES, SIMULATED, VIEW, Devices, Trials
from evetac_cli.names import Capability

IMPORTED, RECORDED, MOVED, ADJUSTABLE = (
    (capability,) for capability in (Capability.IMPORT, Capability.RECORDED, Capability.MOVED, Capability.ADJUSTABLE)
)
READOUT_RATES = (
    *("constant-100", "constant-200", "constant-500", "constant-1000", "lossy-2000", "lossy-5000", "lossy-10000"),
    *("variable-2000", "variable-5000", "variable-10000", "variable-15000"),
)


@dataclass(frozen=True)
class Record(Devices, Trials):
    """Record events from a simulated scene or from devices, or import an event file of another format."""

    scene: str = parameter(
        "slip",
        "Scene (`evetac list scenes`) or TOML file.",
        needs=SIMULATED,
    )
    objects: str = parameter(
        "8",
        "Objects of the paper's table, 1 to 20, e.g. `8` or `1-3,10`; or a TOML file.",
        flag="--object",
        needs=SIMULATED,
    )
    tones: str | None = parameter(
        None,
        "Tones to play, each from 1 to 2500 Hz, e.g. `200,300`; default: the scene's.",
        unit="Hz",
        flag="--tone",
        panel=SCENE,
        needs=(Capability.STEPPED,),
    )
    source: Path | None = parameter(
        None,
        f"Import an event file instead: {', '.join(form.partition(' (')[0] for form in names.IMPORTS.values())}.",
        flag="--from",
        recipe=False,
    )
    dots: Path | None = parameter(
        None,
        "Make the events of dots that another simulator moved instead: .npz or .parquet with t_s and dot_xy_px"
        " or dot_xy_mm, and optional forces and slip (docs/any-simulator.md), as the camera of --sensor sees them.",
        flag="--from-dots",
        recipe=False,
        panel=EXPERTS,
    )
    frame_size: str | None = parameter(
        None,
        "Frame size of an imported file that does not state it, e.g. 640x480; default: that of the smallest known"
        " sensor that covers all events.",
        unit="px",
        panel=EXPERTS,
        needs=IMPORTED,
    )
    sort: bool = parameter(
        False,
        "Sort imported events by time. Without this flag, a file whose time steps back by 1 ms or more is refused.",
        panel=EXPERTS,
        needs=IMPORTED,
    )
    drop_late: bool = parameter(
        False,
        "Drop imported events that are 1 ms or more older than an event before them, instead of refusing the file.",
        panel=EXPERTS,
        needs=IMPORTED,
    )
    from_restart: int | None = parameter(
        None,
        "If the clock of the imported file restarts: keep only the part from this restart to the next. 0 keeps the part"
        " before the first restart.",
        low=0,
        high=1000,
        panel=EXPERTS,
        needs=IMPORTED,
    )
    stream: str | None = parameter(
        None,
        "Event stream, topic, camera or array to import, if the file has several.",
        panel=EXPERTS,
        needs=IMPORTED,
    )
    columns: str | None = parameter(
        None,
        "Order of the four columns of an imported file without column names, e.g. `x y t p`.",
        panel=EXPERTS,
        needs=IMPORTED,
    )
    time_unit: str | None = parameter(
        None,
        "Unit of time in an imported text, numpy or HDF5 file that does not state it; default: us if all times are"
        " whole numbers, s otherwise.",
        choices=("s", "ms", "us", "ns"),
        panel=EXPERTS,
        needs=IMPORTED,
    )
    frames: bool = parameter(
        False,
        "Keep also the image frames of an imported AEDAT4 file or ROS bag. IMU samples and triggers are always kept.",
        panel=EXPERTS,
        needs=IMPORTED,
    )
    seconds: float | None = parameter(
        None,
        "Duration; with --listen, the longest of a trial. Default: until the gripper has let go, or Ctrl-C.",
        unit="s",
        low=0.001,
        high=86400.0,
        recipe=False,
        panel=DEVICES,
        needs=(Capability.DEVICE, Capability.PREVIEW),
    )
    closing_ma: int = parameter(
        10,
        "Motor current that closes the gripper until contact.",
        unit="mA",
        low=1,
        high=500,
        recipe=False,
        panel=EXPERTS,
        needs=MOVED,
    )
    holding_ma: float | None = parameter(
        None,
        "Motor current that holds the object; default: that of the virtual scene, 50 otherwise.",
        unit="mA",
        low=0.0,
        high=1000.0,
        recipe=False,
        panel=EXPERTS,
        needs=MOVED,
    )
    hold_s: float = parameter(
        1.0,
        "How long the object is held before the current is lowered.",
        unit="s",
        low=0.0,
        high=3600.0,
        recipe=False,
        panel=EXPERTS,
        needs=MOVED,
    )
    lowest_ma: float = parameter(
        -50.0,
        "Lowest motor current: the recording ends when it is reached. Must be less than --holding-ma.",
        unit="mA",
        low=-500.0,
        high=1000.0,
        recipe=False,
        panel=EXPERTS,
        needs=MOVED,
    )
    current_of: str | None = parameter(
        None,
        "Follow the current profile of this scene (grip-steps, or a TOML file) instead of closing, holding and lowering"
        " the current.",
        recipe=False,
        panel=EXPERTS,
        needs=MOVED,
    )
    threshold_on: int | None = parameter(
        None,
        "Contrast threshold of ON events (brighter): 0 is most sensitive, 17 least; default: the driver's.",
        low=0,
        high=17,
        recipe=False,
        panel=EXPERTS,
        needs=ADJUSTABLE,
    )
    threshold_off: int | None = parameter(
        None,
        "Contrast threshold of OFF events (darker); default: the driver's.",
        low=0,
        high=17,
        recipe=False,
        panel=EXPERTS,
        needs=ADJUSTABLE,
    )
    readout_rate: str | None = parameter(
        None,
        "Readout mode of the sensor and its frames per second; default: variable-5000.",
        choices=READOUT_RATES,
        recipe=False,
        panel=EXPERTS,
        needs=ADJUSTABLE,
    )
    expected_event_rate: float = parameter(
        1e6,
        "Event rate for which the disk must have enough space when the recording starts.",
        unit="1/s",
        low=0.0,
        high=1e9,
        recipe=False,
        panel=EXPERTS,
        needs=RECORDED,
    )
    resume: bool = parameter(
        False,
        "Continue a series that was interrupted; the setup must be the same.",
        recipe=False,
        panel=EXPERTS,
        needs=RECORDED,
    )
    preview: bool = parameter(
        False,
        "Only show the camera's view in the browser.",
        recipe=False,
        panel=VIEW,
        needs=SERIES,
    )

    @property
    def shown(self) -> bool:
        """Whether the trials are shown while they run; a preview always is."""
        return self.live or self.preview


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
