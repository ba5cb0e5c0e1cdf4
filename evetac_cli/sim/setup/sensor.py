"""The settings of a sensor: its camera, gel, dots and gripper, from a row of sensors.toml or a file of --sensor.

Values that a sensor leaves out are those fitted to the paper's figures (sim/gel/gel.py, sim/gripper.py).
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
PAD_M = (20e-3, 15e-3)  # size of the part of a cut gel that can touch an object, along x and y


@dataclass(frozen=True, kw_only=True)
class ReadoutLimit:
    """The limit of the camera's readout, which delays events under load."""

    events_per_s: float = number("largest number of events that the readout transfers per second", 1e3, 1e10)


@dataclass(frozen=True, kw_only=True)
class NoiseFilterSettings:
    """The noise filter that the host applies to the camera's events."""

    support_ms: float = number(
        "an event is kept only if one of its 8 neighbouring pixels had an event less than this time before it",
        0.001,
        1e4,
    )


@dataclass(frozen=True, kw_only=True)
class HotPixelTable:
    """Hot pixels at known positions; entry i of every list belongs to the same pixel."""

    x_px: tuple[int, ...] = wholes("column of each hot pixel", 0, FRAME_PX[0] - 1, HOT)
    y_px: tuple[int, ...] = wholes("row of each hot pixel", 0, FRAME_PX[1] - 1, HOT)
    rate_hz: tuple[float, ...] = numbers("events per second of each hot pixel", None, 1e5, HOT, above=0)
    on_share: tuple[float, ...] = numbers("share of ON events of each hot pixel", 0, 1, HOT)
    polarity_change_share: tuple[float, ...] = numbers(
        "share of events whose polarity differs from that of the pixel's previous event", 0, 1, HOT
    )
    dead_time_us: float = number("shortest time between two events of a pixel, the same for all hot pixels", 0, 1e5)
    short_interval_share: tuple[float, ...] = numbers(
        "share of the intervals between events that follow the shorter of two exponential distributions", 0, 0.999, HOT
    )
    short_interval_us: tuple[float, ...] = numbers(
        "mean of the shorter exponential distribution, without the dead time", 0, 1e8, HOT
    )

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
    """Viscoelastic creep of the gel: Maxwell arms in addition to its fast one; entry i of both lists is one arm."""

    share: tuple[float, ...] = numbers(
        "stiffness of each arm under a sudden load, relative to the gel's shear stiffness", 0, 10, (1, 8)
    )
    time_s: tuple[float, ...] = numbers("relaxation time of each arm", 1e-3, 1e5, (1, 8))

    COLUMNS: ClassVar = ("share", "time_s")


@dataclass(frozen=True, kw_only=True)
class GelFriction:
    """Friction properties of the gel, which replace the values that a scene samples."""

    kinetic_share: float | None = number(
        "kinetic divided by static friction; objects with their own ratio vary about this one", 0, 1, default=None
    )
    stribeck_mm_s: float | None = number(
        "Stribeck velocity: the slip speed at which friction falls from static to kinetic", 0.01, 1e4, default=None
    )
    memory_um: float | None = number(
        "slip distance over which friction adapts to the slip speed", 0, 1000, default=None
    )
    pressure_exponent: float | None = number(
        "friction grows as p^(1 - this) with the pressure p. 0: in proportion to p; 1: independent of p",
        0,
        1,
        default=None,
    )
    patch_spread: float | None = number(
        "relative standard deviation of friction over the gel's surface; needs patch_mm", 0, 1, default=None
    )
    patch_mm: float | None = number(
        "distance over which friction varies on the gel's surface; needs patch_spread", 0.1, 100, default=None
    )


@dataclass(frozen=True, kw_only=True)
class SensorGripper:
    """The sensor's gripper, if it differs from the standard one."""

    force_per_current_n_ma: float | None = number(
        "force of one finger per motor current, in N/mA", 1e-3, 100, default=None
    )
    gain_ma_tick: float | None = number(
        "position gain: motor current per tick between goal and encoder", 0, 1e4, default=None
    )
    servo_n_tick: float | None = number(
        "servo stiffness: force of one finger per tick between goal and encoder; needs two_ticks_n",
        0,
        1e4,
        default=None,
    )
    two_ticks_n: float | None = number(
        "force of one finger for an error of two ticks, minus the gear friction; needs servo_n_tick",
        0,
        1e4,
        default=None,
    )
    friction_n: float | None = number("gear friction without load", 0, 1e3, default=None)
    friction_factor: float = number("factor on the gear friction that follows from the other keys", 0, 100, default=1.0)
    friction_share: float | None = number("gear friction per force on the finger", 0, 0.99, default=None)
    kinetic_share: float | None = number(
        "kinetic divided by static friction of the gear; below 1 the gear breaks loose when it starts",
        0,
        1,
        default=None,
    )
    finger_stiffness_n_m: float | None = number(
        "stiffness of fingers, links and mounts against the gap", 1, 1e7, default=None
    )
    damping_n_s_m: float | None = number("viscous damping of a finger", 0, 1e5, default=None)
    mass_kg: float | None = number("effective mass of a finger with its rotating parts", 0.01, 100, default=None)
    speed_limit_m_s: float | None = number("largest speed of a finger", 1e-4, 10, default=None)
    current_limit_ma: float | None = number("largest motor current", 1, 1e4, default=None)
    backlash_ticks: float = number(
        "backlash between motor and finger, in gripper ticks, unless the scene sets it",
        0,
        50,
        default=0.0,
    )
    encoder_noise_ticks: float = number(
        "standard deviation of the encoder's position noise, unless the scene sets it",
        0,
        50,
        default=0.0,
    )
    command_delay_ms: float = number(
        "delay until a command takes effect (USB, bus, servo), unless the scene sets it",
        0,
        1000,
        default=0.0,
    )
    command_jitter_ms: float = number(
        "random extra delay of a command, uniform from 0 to this, unless the scene sets it", 0, 1000, default=0.0
    )


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """The settings of one sensor."""

    summary: str = words("one-line description of the sensor", 200)
    seed: int = whole(
        "seed of this sensor's individual values: positions of its dots, pixel thresholds, hot pixels", 0, 2**31 - 1
    )
    frame_px: tuple[int, int] = constant("width and height of the frame", list(FRAME_PX))
    mm_per_px: float = number("size of a pixel on the gel's surface", 0.001, 1)
    dot_columns_px: tuple[float, ...] = numbers(
        "x of each column of dots, rising", -100, 740, (2, 20), order="rising", default=()
    )
    dot_rows_px: tuple[float, ...] = numbers(
        "y of each row of dots, rising", -100, 580, (2, 20), order="rising", default=()
    )
    dot_jitter_px: float = number("standard deviation of the dots' positions about the grid", 0, 20, default=0.0)
    dot_xy_px: tuple[tuple[tuple[float, float], ...], ...] = lists(
        "[x, y] of every dot at rest, in rows of equal length; dots without a grid form a single row",
        {"type": "array", "items": pairs(0, FRAME_PX[0]), "minItems": 1, "maxItems": 256},
        (1, 256),
        default=(),
    )
    turned_deg: float = number("rotation of the grid of dots about the middle of the frame", -45, 45, default=0.0)
    dot_radius_px: float = number("mean radius of the dots", 1, 100)
    dot_radius_spread: float = number("relative standard deviation of the dots' radii", 0, 0.3, default=0.0)
    dot_contrast_spread: float = number("relative standard deviation of the dots' log contrasts", 0, 0.3, default=0.0)
    window_px: tuple[int, int, int, int] = wholes(
        "x0, y0, x1, y1 of the window of a cut gel; x1 and y1 are excluded", 0, FRAME_PX[0], 4
    )
    cut_contrast: float = number(
        "contrast of the cut edge next to the window, in log units darker than the gel", 0, 5, default=0.0
    )
    cut_width_px: float = number("full width of the cut edge at half its contrast", 0.1, 50, default=3.0)
    cut_jitter_px: float = number(
        "standard deviation of the ends of the cut edge about the window's border", 0, 20, default=0.0
    )
    threshold: float = number("contrast threshold, in log units; that of ON events if threshold_off is set", 0.01, 10)
    threshold_off: float | None = number(
        "contrast threshold of OFF events, in log units; if left out, it equals threshold", 0.01, 10, default=None
    )
    mismatch: float = number("relative standard deviation of the contrast thresholds over pixels", 0, 1)
    edge_sigma_px: float = number("blur of a dot's edge, as the standard deviation of a Gaussian", 0.1, 20)
    log_contrast: float = number("contrast between gel and dot, in log units", 0.05, 10)
    bandwidth_hz: float = number(
        "cutoff frequency of the pixels' low-pass; 0: pixels follow every change at once", 0, 1e6, default=0.0
    )
    bandwidth_by_light: bool = flag(
        "true: a pixel's bandwidth is proportional to its brightness; bandwidth_hz then applies to bare gel",
        default=False,
    )
    light_gradient: float = number(
        "vignetting: relative loss of light at the frame's corners compared with its middle", 0, 0.9, default=0.0
    )
    distortion: tuple[float, float] = numbers(
        "lens distortion k1, k2: a point at distance r from the frame's middle is seen at r (1 + k1 r^2 + k2 r^4);"
        " r = 1 at the corners",
        -0.3,
        0.3,
        2,
        default=(0.0, 0.0),
    )
    leak_hz: float = number("leak events per second of every pixel", 0, 10, default=0.0)
    refractory_us: float = number("refractory period: dead time of a pixel after an event", 0, 1e6, default=0.0)
    readout: ReadoutLimit | None = table(ReadoutLimit)
    noise_hz: float = number("noise events per second of a pixel that is not hot", 0, 1e4)
    noise_on_share: float = number("share of ON events among the noise events", 0, 1, default=0.5)
    timestamp_step_us: float = number(
        "noise events occur at multiples of this time, with an offset that grows from column to column; 0: at any time",
        0,
        500,
        default=0.0,
    )
    hot_pixels: int = whole(
        "number of hot pixels; their positions are random; needs hot_pixel_hz", 0, MOST_HOT_PIXELS, default=0
    )
    hot_pixel_hz: tuple[float, ...] = numbers(
        "evenly spaced quantiles of the hot pixels' event rates, rising",
        0,
        1e5,
        (2, 1000),
        order="rising",
        default=(),
    )
    hot_pixel_table: HotPixelTable | None = table(HotPixelTable)
    noise_filter: NoiseFilterSettings | None = table(NoiseFilterSettings)
    shear_modulus_pa: float = number("shear modulus of the gel", 1e3, 1e8)
    normal_modulus_pa: float = number("modulus of the gel under normal pressure", 1e3, 1e9)
    loss_tangent: float | None = number("loss tangent of the gel at 100 Hz", 0, 2, default=None)
    creep: GelCreep | None = table(GelCreep)
    static_friction_factor: float = number(
        "factor of this gel on the static friction of all objects", 0.01, 100, default=1.0
    )
    friction: GelFriction = table(GelFriction, default=GelFriction())
    gripper: SensorGripper = table(SensorGripper, default=SensorGripper())

    def pad_m(self, *, cut: bool) -> tuple[float, float, float, float]:
        """Return the borders x0, y0, x1, y1 of the pad, in m from the frame's middle.

        A cut gel ends at the window, a closed gel at the frame's border.
        """
        cut_m = (self.window_px[0] - FRAME_PX[0] / 2) * self.mm_per_px * 1e-3
        end_m = cut_m if cut else FRAME_PX[0] / 2 * self.mm_per_px * 1e-3
        return cut_m - PAD_M[0], -PAD_M[1] / 2, end_m, PAD_M[1] / 2

    def sensitivity(self) -> Sensitivity:
        """Return how strongly the sensor responds to contact; its ON and OFF thresholds are averaged."""
        off = self.threshold if self.threshold_off is None else self.threshold_off
        ratio = self.log_contrast * (1.0 / self.threshold + 1.0 / off) / 2.0
        return Sensitivity(ratio, self.shear_modulus_pa)


@dataclass(frozen=True, kw_only=True)
class SensorFile(Sensor):
    """A file of --sensor: a sensor and the keys that only a file has."""

    name: str | None = words("name of the sensor in recordings", 40, pattern=SENSOR_NAME, default=None)
    like: str | None = words("named sensor that supplies every key that the file leaves out", 40, default=None)


SensorRanges = Mapping[str, Any]  # the row `randomized` of sensors.toml, from which a sensor is sampled
