"""What a built sensor is: its camera, its gel, its dots and its gripper; a row of sensors.toml, or a file of --sensor.

What a sensor does not name is as fitted to the paper's figures (sim/gel/gel.py, sim/gripper.py).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.sensitivity import Sensitivity
from evetac_cli.sim.setup.tables import (
    constant,
    flag,
    lists,
    number,
    numbers,
    pairs,
    table,
    whole,
    wholes,
    words,
)

SENSOR_NAME = "^[a-z][a-z0-9-]{0,39}$"
MOST_HOT_PIXELS = 10_000
HOT = (0, MOST_HOT_PIXELS)
PAD_M = (20e-3, 15e-3)  # the part of a cut gel that can touch, along x and y


@dataclass(frozen=True, kw_only=True)
class ReadoutLimit:
    """The readout of the camera, where it slows down under load."""

    events_per_s: float = number("most events that are read per second", 1e3, 1e10)


@dataclass(frozen=True, kw_only=True)
class NoiseFilterSettings:
    """The filter that the host puts behind the camera against noise."""

    support_ms: float = number(
        "an event is left out unless one of the 8 pixels around its own had one less than this time before", 0.001, 1e4
    )


@dataclass(frozen=True, kw_only=True)
class HotPixelTable:
    """Hot pixels of known place; of each the value at its place in every list."""

    x_px: tuple[int, ...] = wholes("column", 0, FRAME_PX[0] - 1, HOT)
    y_px: tuple[int, ...] = wholes("row", 0, FRAME_PX[1] - 1, HOT)
    rate_hz: tuple[float, ...] = numbers("events per second", None, 1e5, HOT, above=0)
    on_share: tuple[float, ...] = numbers("share of ON events", 0, 1, HOT)
    polarity_change_share: tuple[float, ...] = numbers(
        "share of events whose polarity is not that of the event before", 0, 1, HOT
    )
    dead_time_us: float = number("shortest time between two events, of all of them", 0, 1e5)
    short_interval_share: tuple[float, ...] = numbers(
        "share of the times between events that come from the shorter of two exponentials", 0, 0.999, HOT
    )
    short_interval_us: tuple[float, ...] = numbers("mean of that exponential, beyond the dead time", 0, 1e8, HOT)

    COLUMNS: ClassVar = (
        "x_px",
        "y_px",
        "rate_hz",
        "on_share",
        "polarity_change_share",
        "short_interval_share",
        "short_interval_us",
    )


@dataclass(frozen=True, kw_only=True)
class GelCreep:
    """Maxwell arms of the gel beside its quick one, of each the value at its place in both lists."""

    share: tuple[float, ...] = numbers(
        "share of the gel's stiffness in shear with which an arm resists a sudden load", 0, 10, (1, 8)
    )
    time_s: tuple[float, ...] = numbers("time within which an arm yields", 1e-3, 1e5, (1, 8))

    COLUMNS: ClassVar = ("share", "time_s")


@dataclass(frozen=True, kw_only=True)
class GelFriction:
    """Friction of the gel, instead of what a scene samples."""

    kinetic_share: float | None = number(
        "kinetic over static friction; objects that have a share of their own differ about it", 0, 1, default=None
    )
    stribeck_mm_s: float | None = number("slip speed at which friction falls", 0.01, 1e4, default=None)
    memory_um: float | None = number("distance over which friction follows the slip speed", 0, 1000, default=None)
    pressure_exponent: float | None = number(
        "friction under a pressure p goes with p^(1 - this): 0 in proportion, 1 not at all", 0, 1, default=None
    )
    patch_spread: float | None = number(
        "relative standard deviation of friction over the gel; needs patch_mm", 0, 1, default=None
    )
    patch_mm: float | None = number("distance over which friction varies; needs patch_spread", 0.1, 100, default=None)


@dataclass(frozen=True, kw_only=True)
class SensorGripper:
    """The sensor's gripper, where it is not the usual one."""

    force_per_current_n_ma: float | None = number("force of a finger per mA", 1e-3, 100, default=None)
    gain_ma_tick: float | None = number("current per tick that the goal is ahead", 0, 1e4, default=None)
    servo_n_tick: float | None = number(
        "push of a finger per tick that its goal is ahead; needs two_ticks_n", 0, 1e4, default=None
    )
    two_ticks_n: float | None = number(
        "what two ticks push beyond the gear's friction; needs servo_n_tick", 0, 1e4, default=None
    )
    friction_n: float | None = number("of the gear", 0, 1e3, default=None)
    friction_factor: float = number(
        "by how much the gear's friction differs from what the rest of the table gives", 0, 100, default=1.0
    )
    friction_share: float | None = number("of the gear's load", 0, 0.99, default=None)
    kinetic_share: float | None = number(
        "friction of a gear that moves over that of one that rests; below 1 it breaks loose", 0, 1, default=None
    )
    finger_stiffness_n_m: float | None = number("of a finger", 1, 1e7, default=None)
    damping_n_s_m: float | None = number("of a finger", 0, 1e5, default=None)
    mass_kg: float | None = number("of a finger and what turns with it", 0.01, 100, default=None)
    speed_limit_m_s: float | None = number("of a finger", 1e-4, 10, default=None)
    current_limit_ma: float | None = number("of the motor", 1, 1e4, default=None)
    backlash_ticks: float = number(
        "lost motion between motor and finger, in ticks of the gripper, unless a scene names another",
        0,
        50,
        default=0.0,
    )
    encoder_noise_ticks: float = number(
        "standard deviation of what the encoder reads about the motor's place, unless a scene names another",
        0,
        50,
        default=0.0,
    )
    command_delay_ms: float = number(
        "a command takes effect so much later (USB, bus, servo), unless a scene names another time",
        0,
        1000,
        default=0.0,
    )
    command_jitter_ms: float = number(
        "and later by a random time up to this, unless a scene names another", 0, 1000, default=0.0
    )


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A sensor."""

    summary: str = words("one line about the sensor", 200)
    seed: int = whole("draws what belongs to this one sensor: jitter of its dots, thresholds, hot pixels", 0, 2**31 - 1)
    frame_px: tuple[int, int] = constant("width and height of the frame", list(FRAME_PX))
    mm_per_px: float = number("size of a pixel on the gel", 0.001, 1)
    dot_columns_px: tuple[float, ...] = numbers(
        "x of the columns of dots, rising", -100, 740, (2, 20), order="rising", default=()
    )
    dot_rows_px: tuple[float, ...] = numbers(
        "y of the rows of dots, rising", -100, 580, (2, 20), order="rising", default=()
    )
    dot_jitter_px: float = number("standard deviation of single dots about the grid", 0, 20, default=0.0)
    dot_xy_px: tuple[tuple[tuple[float, float], ...], ...] = lists(
        "[x, y] of every dot at rest, rows of equally many; dots in no grid are one row",
        {"type": "array", "items": pairs(0, FRAME_PX[0]), "minItems": 1, "maxItems": 256},
        (1, 256),
        default=(),
    )
    turned_deg: float = number("the grid of dots, turned about the middle of the frame", -45, 45, default=0.0)
    dot_radius_px: float = number("radius of a dot", 1, 100)
    dot_radius_spread: float = number("relative standard deviation of the radius over dots", 0, 0.3, default=0.0)
    dot_contrast_spread: float = number(
        "relative standard deviation of the log contrast over dots", 0, 0.3, default=0.0
    )
    window_px: tuple[int, int, int, int] = wholes(
        "x0, y0, x1, y1 of the window of a cut gel, ends excluded", 0, FRAME_PX[0], 4
    )
    cut_contrast: float = number("the cut edge beside the window, log units darker than the gel", 0, 5, default=0.0)
    cut_width_px: float = number("width of the cut edge at half its depth", 0.1, 50, default=3.0)
    cut_jitter_px: float = number("standard deviation of its ends about the window's border", 0, 20, default=0.0)
    threshold: float = number("contrast threshold, log units", 0.01, 10)
    threshold_off: float | None = number(
        "threshold of OFF events, log units; that of ON where it is left out", 0.01, 10, default=None
    )
    mismatch: float = number("relative standard deviation of the thresholds over pixels", 0, 1)
    edge_sigma_px: float = number("blur of a dot's edge", 0.1, 20)
    log_contrast: float = number("gel against dot, log units", 0.05, 10)
    bandwidth_hz: float = number("of the pixels; 0: as fast as anything moves", 0, 1e6, default=0.0)
    bandwidth_by_light: bool = flag(
        "true: a pixel's bandwidth is proportional to its brightness, bandwidth_hz that of bare gel", default=False
    )
    light_gradient: float = number(
        "by what share less light falls on the frame's corners than on its middle", 0, 0.9, default=0.0
    )
    distortion: tuple[float, float] = numbers(
        "k1 and k2 of the lens: a point at r from the frame's middle is seen at r (1 + k1 r^2 + k2 r^4), corners at"
        " r = 1",
        -0.3,
        0.3,
        2,
        default=(0.0, 0.0),
    )
    leak_hz: float = number("events per second that leak makes in every pixel", 0, 10, default=0.0)
    refractory_us: float = number("how long a pixel is blind after an event", 0, 1e6, default=0.0)
    readout: ReadoutLimit | None = table(ReadoutLimit)
    noise_hz: float = number("noise events per second of an ordinary pixel", 0, 1e4)
    noise_on_share: float = number("share of ON among them", 0, 1, default=0.5)
    timestamp_step_us: float = number(
        "noise events come at multiples of this time, later from column to column; 0: at any time",
        0,
        500,
        default=0.0,
    )
    hot_pixels: int = whole(
        "number of hot pixels, their places drawn; needs hot_pixel_hz", 0, MOST_HOT_PIXELS, default=0
    )
    hot_pixel_hz: tuple[float, ...] = numbers(
        "evenly spaced quantiles of their rates, rising", 0, 1e5, (2, 1000), order="rising", default=()
    )
    hot_pixel_table: HotPixelTable | None = table(HotPixelTable)
    noise_filter: NoiseFilterSettings | None = table(NoiseFilterSettings)
    shear_modulus_pa: float = number("of the gel", 1e3, 1e8)
    normal_modulus_pa: float = number("of the gel under pressure", 1e3, 1e9)
    loss_tangent: float | None = number("of the gel, at 100 Hz", 0, 2, default=None)
    creep: GelCreep | None = table(GelCreep)
    static_friction_factor: float = number("on all objects", 0.01, 100, default=1.0)
    friction: GelFriction = table(GelFriction, default=GelFriction())
    gripper: SensorGripper = table(SensorGripper, default=SensorGripper())

    def pad_m(self, *, cut: bool) -> tuple[float, float, float, float]:
        """Where its gel ends, x0, y0, x1, y1 from the frame's middle: a cut one at the window, else at the frame."""
        cut_m = (self.window_px[0] - FRAME_PX[0] / 2) * self.mm_per_px * 1e-3
        end_m = cut_m if cut else FRAME_PX[0] / 2 * self.mm_per_px * 1e-3
        return cut_m - PAD_M[0], -PAD_M[1] / 2, end_m, PAD_M[1] / 2

    def sensitivity(self) -> Sensitivity:
        """How strongly the sensor answers contact; ON and OFF thresholds averaged."""
        off = self.threshold if self.threshold_off is None else self.threshold_off
        ratio = self.log_contrast * (1.0 / self.threshold + 1.0 / off) / 2.0
        return Sensitivity(ratio, self.shear_modulus_pa)


@dataclass(frozen=True, kw_only=True)
class SensorFile(Sensor):
    """A file of --sensor: a sensor, and what only its file says."""

    name: str | None = words("what recordings call this sensor", 40, pattern=SENSOR_NAME, default=None)
    like: str | None = words("the named sensor whose row holds for every key that is left out", 40, default=None)


SensorRanges = Mapping[str, Any]  # the row `randomized` of sensors.toml, from which a sensor is sampled
