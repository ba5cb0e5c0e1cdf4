"""The settings of a sensor: its camera, gel, dots and gripper, from a row of sensors.toml or a file of --sensor.

Values that a sensor leaves out are those fitted to the paper's figures (sim/gel/gel.py, sim/gripper.py).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.slip.architectures import Sensitivity
from evetac_cli.sim.setup.tables import RISING, Share, Table, UpTo100, UpTo1000

SENSOR_NAME = "^[a-z][a-z0-9-]{0,39}$"
MOST_HOT_PIXELS = 10_000
OF_DOTS = Meta(min_length=1, max_length=256)
OF_HOT = Meta(max_length=MOST_HOT_PIXELS)
Pixel = Annotated[int, Meta(ge=0, le=FRAME_PX[0])]
Place = Annotated[float, Meta(ge=0, le=FRAME_PX[0])]
PAD_M = (20e-3, 15e-3)  # size of the part of a cut gel that can touch an object, along x and y


@dataclass(frozen=True, kw_only=True)
class ReadoutLimit(Table):
    """The limit of the camera's readout, which delays events under load."""

    #: largest number of events that the readout transfers per second
    events_per_s: Annotated[float, Meta(ge=1000, le=1e10)]


@dataclass(frozen=True, kw_only=True)
class NoiseFilterSettings(Table):
    """The noise filter that the host applies to the camera's events."""

    #: an event is kept only if one of its 8 neighbouring pixels had an event less than this time before it
    support_ms: Annotated[float, Meta(ge=0.001, le=10_000)]


@dataclass(frozen=True, kw_only=True)
class HotPixelTable(Table):
    """Hot pixels at known positions; entry i of every list belongs to the same pixel."""

    #: column of each hot pixel
    x_px: Annotated[tuple[Annotated[int, Meta(ge=0, le=FRAME_PX[0] - 1)], ...], OF_HOT]
    #: row of each hot pixel
    y_px: Annotated[tuple[Annotated[int, Meta(ge=0, le=FRAME_PX[1] - 1)], ...], OF_HOT]
    #: events per second of each hot pixel
    rate_hz: Annotated[tuple[Annotated[float, Meta(gt=0, le=100_000)], ...], OF_HOT]
    #: share of ON events of each hot pixel
    on_share: Annotated[tuple[Share, ...], OF_HOT]
    #: share of events whose polarity differs from that of the pixel's previous event
    polarity_change_share: Annotated[tuple[Share, ...], OF_HOT]
    #: shortest time between two events of a pixel, the same for all hot pixels
    dead_time_us: Annotated[float, Meta(ge=0, le=100_000)]
    #: share of the intervals between events that follow the shorter of two exponential distributions
    short_interval_share: Annotated[tuple[Annotated[float, Meta(ge=0, le=0.999)], ...], OF_HOT]
    #: mean of the shorter exponential distribution, without the dead time
    short_interval_us: Annotated[tuple[Annotated[float, Meta(ge=0, le=1e8)], ...], OF_HOT]

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
class GelCreep(Table):
    """Viscoelastic creep of the gel: Maxwell arms in addition to its fast one; entry i of both lists is one arm."""

    #: stiffness of each arm under a sudden load, relative to the gel's shear stiffness
    share: Annotated[tuple[Annotated[float, Meta(ge=0, le=10)], ...], Meta(min_length=1, max_length=8)]
    #: relaxation time of each arm
    time_s: Annotated[tuple[Annotated[float, Meta(ge=0.001, le=100_000)], ...], Meta(min_length=1, max_length=8)]

    COLUMNS: ClassVar = ("share", "time_s")


@dataclass(frozen=True, kw_only=True)
class GelFriction(Table):
    """Friction properties of the gel, which replace the values that a scene samples."""

    #: kinetic divided by static friction; objects with their own ratio vary about this one
    kinetic_share: Share | None = None
    #: Stribeck velocity: the slip speed at which friction falls from static to kinetic
    stribeck_mm_s: Annotated[float, Meta(ge=0.01, le=10_000)] | None = None
    #: slip distance over which friction adapts to the slip speed
    memory_um: UpTo1000 | None = None
    #: friction grows as p^(1 - this) with the pressure p. 0: in proportion to p; 1: independent of p
    pressure_exponent: Share | None = None
    #: relative standard deviation of friction over the gel's surface; needs patch_mm
    patch_spread: Share | None = None
    #: distance over which friction varies on the gel's surface; needs patch_spread
    patch_mm: Annotated[float, Meta(ge=0.1, le=100)] | None = None


@dataclass(frozen=True, kw_only=True)
class SensorGripper(Table):
    """The sensor's gripper, if it differs from the standard one."""

    #: force of one finger per motor current, in N/mA
    force_per_current_n_ma: Annotated[float, Meta(ge=0.001, le=100)] | None = None
    #: position gain: motor current per tick between goal and encoder
    gain_ma_tick: Annotated[float, Meta(ge=0, le=10_000)] | None = None
    #: servo stiffness: force of one finger per tick between goal and encoder; needs two_ticks_n
    servo_n_tick: Annotated[float, Meta(ge=0, le=10_000)] | None = None
    #: force of one finger for an error of two ticks, minus the gear friction; needs servo_n_tick
    two_ticks_n: Annotated[float, Meta(ge=0, le=10_000)] | None = None
    #: gear friction without load
    friction_n: UpTo1000 | None = None
    #: factor on the gear friction that follows from the other keys
    friction_factor: UpTo100 = 1.0
    #: gear friction per force on the finger
    friction_share: Annotated[float, Meta(ge=0, le=0.99)] | None = None
    #: kinetic divided by static friction of the gear; below 1 the gear breaks loose when it starts
    kinetic_share: Share | None = None
    #: stiffness of fingers, links and mounts against the gap
    finger_stiffness_n_m: Annotated[float, Meta(ge=1, le=1e7)] | None = None
    #: viscous damping of a finger
    damping_n_s_m: Annotated[float, Meta(ge=0, le=100_000)] | None = None
    #: effective mass of a finger with its rotating parts
    mass_kg: Annotated[float, Meta(ge=0.01, le=100)] | None = None
    #: largest speed of a finger
    speed_limit_m_s: Annotated[float, Meta(ge=0.0001, le=10)] | None = None
    #: largest motor current
    current_limit_ma: Annotated[float, Meta(ge=1, le=10_000)] | None = None
    #: backlash between motor and finger, in gripper ticks, unless the scene sets it
    backlash_ticks: Annotated[float, Meta(ge=0, le=50)] = 0.0
    #: standard deviation of the encoder's position noise, unless the scene sets it
    encoder_noise_ticks: Annotated[float, Meta(ge=0, le=50)] = 0.0
    #: delay until a command takes effect (USB, bus, servo), unless the scene sets it
    command_delay_ms: UpTo1000 = 0.0
    #: random extra delay of a command, uniform from 0 to this, unless the scene sets it
    command_jitter_ms: UpTo1000 = 0.0


@dataclass(frozen=True, kw_only=True)
class Sensor(Table):
    """The settings of one sensor."""

    #: one-line description of the sensor
    summary: Annotated[str, Meta(max_length=200)]
    #: seed of this sensor's individual values: positions of its dots, pixel thresholds, hot pixels
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    #: width and height of the frame
    frame_px: tuple[Literal[640], Literal[480]]
    #: size of a pixel on the gel's surface
    mm_per_px: Annotated[float, Meta(ge=0.001, le=1)]
    #: x of each column of dots, rising
    dot_columns_px: Annotated[
        tuple[Annotated[float, Meta(ge=-100, le=740)], ...], Meta(min_length=2, max_length=20), RISING
    ] = ()
    #: y of each row of dots, rising
    dot_rows_px: Annotated[
        tuple[Annotated[float, Meta(ge=-100, le=580)], ...], Meta(min_length=2, max_length=20), RISING
    ] = ()
    #: standard deviation of the dots' positions about the grid
    dot_jitter_px: Annotated[float, Meta(ge=0, le=20)] = 0.0
    #: [x, y] of every dot at rest, in rows of equal length; dots without a grid form a single row
    dot_xy_px: Annotated[tuple[Annotated[tuple[tuple[Place, Place], ...], OF_DOTS], ...], OF_DOTS] = ()
    #: rotation of the grid of dots about the middle of the frame
    turned_deg: Annotated[float, Meta(ge=-45, le=45)] = 0.0
    #: mean radius of the dots
    dot_radius_px: Annotated[float, Meta(ge=1, le=100)]
    #: relative standard deviation of the dots' radii
    dot_radius_spread: Annotated[float, Meta(ge=0, le=0.3)] = 0.0
    #: relative standard deviation of the dots' log contrasts
    dot_contrast_spread: Annotated[float, Meta(ge=0, le=0.3)] = 0.0
    #: x0, y0, x1, y1 of the window of a cut gel; x1 and y1 are excluded
    window_px: tuple[Pixel, Pixel, Pixel, Pixel]
    #: contrast of the cut edge next to the window, in log units darker than the gel
    cut_contrast: Annotated[float, Meta(ge=0, le=5)] = 0.0
    #: full width of the cut edge at half its contrast
    cut_width_px: Annotated[float, Meta(ge=0.1, le=50)] = 3.0
    #: standard deviation of the ends of the cut edge about the window's border
    cut_jitter_px: Annotated[float, Meta(ge=0, le=20)] = 0.0
    #: contrast threshold, in log units; that of ON events if threshold_off is set
    threshold: Annotated[float, Meta(ge=0.01, le=10)]
    #: contrast threshold of OFF events, in log units; if left out, it equals threshold
    threshold_off: Annotated[float, Meta(ge=0.01, le=10)] | None = None
    #: relative standard deviation of the contrast thresholds over pixels
    mismatch: Share
    #: blur of a dot's edge, as the standard deviation of a Gaussian
    edge_sigma_px: Annotated[float, Meta(ge=0.1, le=20)]
    #: contrast between gel and dot, in log units
    log_contrast: Annotated[float, Meta(ge=0.05, le=10)]
    #: cutoff frequency of the pixels' low-pass; 0: pixels follow every change at once
    bandwidth_hz: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    #: true: a pixel's bandwidth is proportional to its brightness; bandwidth_hz then applies to bare gel
    bandwidth_by_light: bool = False
    #: vignetting: relative loss of light at the frame's corners compared with its middle
    light_gradient: Annotated[float, Meta(ge=0, le=0.9)] = 0.0
    #: lens distortion k1, k2: a point at distance r from the frame's middle is seen at r (1 + k1 r^2 + k2 r^4); r = 1
    #: at the corners
    distortion: tuple[Annotated[float, Meta(ge=-0.3, le=0.3)], Annotated[float, Meta(ge=-0.3, le=0.3)]] = (0.0, 0.0)
    #: leak events per second of every pixel
    leak_hz: Annotated[float, Meta(ge=0, le=10)] = 0.0
    #: refractory period: dead time of a pixel after an event
    refractory_us: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    readout: ReadoutLimit | None = None
    #: noise events per second of a pixel that is not hot
    noise_hz: Annotated[float, Meta(ge=0, le=10_000)]
    #: share of ON events among the noise events
    noise_on_share: Share = 0.5
    #: noise events occur at multiples of this time, with an offset that grows from column to column; 0: at any time
    timestamp_step_us: Annotated[float, Meta(ge=0, le=500)] = 0.0
    #: number of hot pixels; their positions are random; needs hot_pixel_hz
    hot_pixels: Annotated[int, Meta(ge=0, le=10_000)] = 0
    #: evenly spaced quantiles of the hot pixels' event rates, rising
    hot_pixel_hz: Annotated[
        tuple[Annotated[float, Meta(ge=0, le=100_000)], ...],
        Meta(min_length=2, max_length=1000),
        RISING,
    ] = ()
    hot_pixel_table: HotPixelTable | None = None
    noise_filter: NoiseFilterSettings | None = None
    #: shear modulus of the gel
    shear_modulus_pa: Annotated[float, Meta(ge=1000, le=1e8)]
    #: modulus of the gel under normal pressure
    normal_modulus_pa: Annotated[float, Meta(ge=1000, le=1e9)]
    #: loss tangent of the gel at 100 Hz
    loss_tangent: Annotated[float, Meta(ge=0, le=2)] | None = None
    creep: GelCreep | None = None
    #: factor of this gel on the static friction of all objects
    static_friction_factor: Annotated[float, Meta(ge=0.01, le=100)] = 1.0
    friction: GelFriction = GelFriction()
    gripper: SensorGripper = SensorGripper()

    @property
    def is_slow_in_dark(self) -> bool:
        """Whether the pixels are slow, and slower in the dark."""
        return self.bandwidth_hz > 0.0 and self.bandwidth_by_light

    def stiffer(self, factor: float) -> "Sensor":
        """Return the sensor with a gel that is stiffer by a factor, in shear and under pressure."""
        shear_pa, normal_pa = self.shear_modulus_pa * factor, self.normal_modulus_pa * factor
        return replace(self, shear_modulus_pa=shear_pa, normal_modulus_pa=normal_pa)

    def has_dark_cut(self, *, cut: bool) -> bool:
        """Return whether the edge of the gel next to the window is visible; only a cut gel has one."""
        return cut and self.cut_contrast > 0.0

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


SensorRanges = Mapping[str, Any]  # the row `randomized` of sensors.toml, from which a sensor is sampled
