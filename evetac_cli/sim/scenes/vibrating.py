"""Scenes of kind `tone`: a speaker pressed on the gel plays a pure tone; the dots' motion has a closed form.

The surface moves s(t) = A [sin wt + h2 sin(2wt + 90 deg)] (1 + m sin(wt/2 + phase)). This is a tone, its second
harmonic, and a subharmonic, which a rattling contact causes. Both h2 and m drift slowly. Expanded, s is a sum of five
waves, at f/2 to 5f/2 in steps of f/2. A linear gel answers each wave with its own gain and phase. So there is nothing
to solve and no time step: the sum gives the position of a dot at any time. Two motions add up along each dot's path:

- the indentation s squeezes the gel aside, and dots that come nearer to the lens look larger, both without delay;
- a share of s moves the surface along a fixed direction, because no speaker is mounted exactly upright. It is
  multiplied by the response of the layer's first thickness resonance, f_0 = c / 4H: 1 / (1 - (f / f_0)^2 / g). Here g
  is the complex shear modulus divided by G for the gel of all scenes (gel.py): 1 + i w tau_v + the sum of
  g i w tau / (1 + i w tau) over its arms.

Not simulated: friction and slip, motion of a cut gel's edge, modes above the first, the gel's inertia along the normal,
and loss of contact. So h2 and m are set by hand, and the face pulls when A exceeds the indentation. A, h2, m and their
dependence on the tone are tuned so that the paper's method of reading frequencies is wrong as often as in the paper.

A constant loss tangent of 0.15 would amplify waves near 753 Hz five times and shift the phase of the harmonics. At
498 Hz the subharmonic then won with most of the tried seeds, where the paper's method was never wrong.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICE_US, SLICES_PER_S, Events
from evetac_cli.kernels.gel_layer import Squeeze, moved_by
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.gel import dots
from evetac_cli.sim.gel.contact import cell_area, pad_nodes
from evetac_cli.sim.gel.gel import GelMaterial
from evetac_cli.sim.scenes.shared import material
from evetac_cli.sim.scenes.true_slip import NO_SLIP
from evetac_cli.sim.setup.parts import CAMERA, Timer, untimed
from evetac_cli.sim.setup.plan import Plan

ORDERS = np.array([0.5, 1.0, 1.5, 2.0, 2.5])  # frequencies of the surface's waves, as multiples of the tone
FADE_S = 0.02  # the tone fades in and out over this time, because its response is the stationary one
PIECES = 5  # pieces per slice, or a multiple: the scanning camera scans 5 times per slice, so it interpolates nothing
PIECES_A_PERIOD = 16  # least number of pieces per period; 8 per period of the second harmonic
MARGIN = 2.0  # heights of gel beyond all points; more would change their motion by at most 1.5 % rms
BLOCK = 50  # slices whose waves are evaluated together, because numpy's overhead would be 0.3 ms per slice

Complexes = NDArray[np.complex128]


def waves(second_harmonic: Floats, modulation: Floats, phase_rad: float) -> Complexes:
    """Return the complex amplitudes (..., 5) of the surface's waves: s/A = Re sum_j waves_j exp(i ORDERS_j w t).

    `second_harmonic` and `modulation` are h2 and m, of the same shape.
    """
    turn = np.exp(1j * phase_rad)
    half = modulation / 2
    parts = (
        half * turn.conjugate(),
        np.full_like(half, -1j, np.complex128),
        -half * turn + 1j * half * second_harmonic * turn.conjugate(),
        second_harmonic + 0j,
        -1j * half * second_harmonic * turn,
    )
    return np.stack(parts, axis=-1)


def resonance(frequency_hz: Floats, layer: GelMaterial) -> Complexes:
    """Return the complex gain of the layer's surface motion along itself, relative to its base, at each frequency."""
    first_hz = math.sqrt(layer.shear_modulus_pa / layer.density_kg_m3) / (4 * layer.height_m)
    turning = 2j * np.pi * frequency_hz
    modulus = 1.0 + turning * layer.viscous_time_s
    for share, time_s in layer.arms:
        in_arm = turning * time_s
        modulus = modulus + share * in_arm / (1.0 + in_arm)
    return np.asarray(1.0 / (1.0 - (frequency_hz / first_hz) ** 2 / modulus), np.complex128)


def pressed_by_disc(
    points_m: Floats, centre_m: Floats, radius_m: float, layer: GelMaterial, normal_modulus_pa: float
) -> tuple[Floats, Floats, Floats]:
    """Return the response of points on the gel (points, 2) per metre that a sticking disc is pressed in or moved aside.

    The first result is the points' shift (points, 2) when the disc is pressed in, from squeeze and lens. The second,
    (points, 2, 2), is their motion along x and y for a motion of the disc along x (last index 0) and y (last index 1);
    points under the disc move with it. The third, (2, 2), is the force on the disc for such motions, divided by the
    shear modulus, in m.

    The layer is that of all scenes (see kernels/gel_layer), in equilibrium. Its nodes reach MARGIN heights beyond all
    points. Their distance is an eighth of the height or of the radius, but not below that for a disc of a quarter of
    the height.
    """
    height_m = layer.height_m
    pitch_m = min(height_m, max(radius_m, height_m / 4)) / 8
    low_m = np.minimum(points_m.min(axis=0), centre_m - radius_m) - MARGIN * height_m
    high_m = np.maximum(points_m.max(axis=0), centre_m + radius_m) + MARGIN * height_m
    columns, rows = np.ceil((high_m - low_m) / pitch_m - 1e-9).astype(int).tolist()
    nodes = pad_nodes(columns, rows, (low_m[0], high_m[0]), (low_m[1], high_m[1]))
    covered = np.clip((radius_m - np.linalg.norm(nodes - centre_m, axis=2)) / pitch_m + 0.5, 0.0, 1.0)
    pressed_m2 = normal_modulus_pa / layer.shear_modulus_pa / height_m * cell_area(nodes) * covered
    fields = moved_by(nodes, height_m, covered >= 0.5, Squeeze(nodes, height_m).of(pressed_m2))
    at_points = dots.interpolation(nodes, points_m)
    along = dots.field_at(fields.reshape(rows, columns, 6), *at_points).reshape(-1, 2, 3)
    shift: Floats = along[..., 0] + dots.nearer_by(points_m, dots.field_at(covered[..., None], *at_points)[:, 0])
    # a layer in equilibrium responds as if each of its pieces was a separate spring
    answer_m: Floats = fields[..., 1:].sum(axis=(0, 1)) * cell_area(nodes) / height_m
    return shift, along[..., 1:], answer_m


class Drift(NamedTuple):
    """A quantity that drifts smoothly (a cosine) between random values at random times."""

    time_s: Floats
    value: Floats

    @classmethod
    def sample(
        cls, low: float, high: float, hold_s: tuple[float, float], end_s: float, rng: np.random.Generator
    ) -> Any:
        """Sample values uniform in [low, high] up to end_s; the time from one to the next is uniform in `hold_s`."""
        assert 0.0 < hold_s[0] <= hold_s[1] and end_s < math.inf
        steps = math.ceil(end_s / hold_s[0]) + 1
        time_s = np.append(0.0, np.cumsum(rng.uniform(*hold_s, steps)))
        return cls(time_s, rng.uniform(low, high, steps + 1))

    def at(self, time_s: Floats) -> Floats:
        """Return the values at some times."""
        after = np.clip(np.searchsorted(self.time_s, time_s, side="right"), 1, len(self.time_s) - 1)
        start_s = self.time_s[after - 1]
        part = np.clip((time_s - start_s) / (self.time_s[after] - start_s), 0.0, 1.0)
        share = 0.5 - 0.5 * np.cos(np.pi * part)
        value: Floats = self.value[after - 1] + share * (self.value[after] - self.value[after - 1])
        return value


@dataclass(frozen=True)
class SampledTone:
    """Values that were sampled for one tone from the ranges of its scene; h2 and m are in the truth of every slice."""

    tone_hz: float
    amplitude_um: float
    tangential_share: float
    direction_rad: float
    subharmonic_phase_rad: float
    offset_mm: tuple[float, float]


class SpeakerMotion(NamedTuple):
    """Motion of the speaker at some times: force, indentation, motion along the surface, and their parameters."""

    force_n: Floats
    depth_m: Floats
    along_m: Floats
    amplitude_m: Floats
    second_harmonic: Floats
    modulation: Floats


class Vibration:
    """A trial with one tone: `step` advances by one slice, `truth` returns its ground truth."""

    def __init__(
        self,
        plan: Plan,
        mechanics: np.random.Generator,
        optics_rng: np.random.Generator,
        *,
        timer: Timer = untimed,
    ) -> None:
        """Build the parts that a plan names."""
        scene, tone = plan.scene, plan.scene.tone
        assert tone is not None and plan.tone_hz is not None
        sensor = plan.with_gel_of_scene().sensor
        self._time = scene.time
        self.gel_camera = GelCamera(sensor, scene=scene, texture=None, rng=optics_rng)
        self._render = timer(CAMERA.name, self.gel_camera.render)
        layer = material(sensor)
        radius_m = tone.radius_mm * 1e-3
        offset_m = mechanics.uniform(-1.0, 1.0, 2) * tone.offset_mm * 1e-3
        share = float(mechanics.uniform(*tone.tangential_share))
        direction_rad, phase_rad = mechanics.uniform(0.0, 2 * np.pi, 2)
        factor = float(mechanics.uniform(*tone.amplitude_factor))

        self._hz = plan.tone_hz
        self._along = share * resonance(ORDERS * self._hz, layer)
        rest_m, modulus_pa = self.gel_camera.rest_m, sensor.normal_modulus_pa
        self._shift, aside, answer_m = pressed_by_disc(rest_m, offset_m, radius_m, layer, modulus_pa)
        direction = np.array([np.cos(direction_rad), np.sin(direction_rad)])
        self._sideways = aside @ direction
        amplitude_m = factor * tone.at(tone.dot_motion_px, self._hz) * self.gel_camera.mm_per_px * 1e-3
        motion = self._shift + self._sideways * self._along[1]  # by the tone alone, per metre of the surface's
        self._amplitude_m = amplitude_m / float(np.sqrt((np.abs(motion) ** 2).sum(axis=1).mean()))
        # shear force per motion along the surface, with the gel around the disc, and indentation per normal force
        area_m2 = math.pi * radius_m**2
        self._shear_n_m = layer.shear_modulus_pa * (answer_m @ direction)
        self._depth_m_n = layer.height_m / (sensor.normal_modulus_pa * area_m2)
        self._press_n, self._press_s = tone.normal_n, tone.press_s

        low, high = (tone.at(ends, self._hz) for ends in (tone.second_harmonic_least, tone.second_harmonic_most))
        self._second_harmonic = Drift.sample(low, high, tone.drift_s, self._time.tone_s, mechanics)
        most = tone.at(tone.modulation_most, self._hz)
        self._modulation = Drift.sample(0.0, most, tone.drift_s, self._time.tone_s, mechanics)
        self.sampled = SampledTone(
            tone_hz=self._hz,
            amplitude_um=self._amplitude_m * 1e6,
            tangential_share=share,
            direction_rad=float(direction_rad),
            subharmonic_phase_rad=float(phase_rad),
            offset_mm=(float(offset_m[0]) * 1e3, float(offset_m[1]) * 1e3),
        )
        self._pieces = PIECES * math.ceil(PIECES_A_PERIOD * self._hz * 1e-3 / PIECES)
        self._now = SpeakerMotion(*(np.zeros(()) for _ in SpeakerMotion._fields))
        self.slices = 0
        whole_s = self._time.tone_at_s + self._time.tone_s + self._time.after_motion_s
        self.slices_in_all = round(SLICES_PER_S * whole_s)
        self.finished = False

    def step(self) -> Events:
        """Advance by one slice and return its events; sets `finished` with the last one."""
        first = self.slices % BLOCK * self._pieces
        if first == 0:
            self._start_block()
        end = first + self._pieces
        columns = (self._block.depth_m, self._block.along_m)
        depth_m, along_m = (column[first : end + 1, None, None] for column in columns)
        path_m = depth_m * self._shift + along_m * self._sideways  # of the dots, (times, dots, 2)
        events = self._render(path_m[-1], np.zeros(2), 0.0, self.slices * SLICE_US, path_m)
        self._now = SpeakerMotion(*(column[end] for column in self._block))
        self.slices += 1
        self.finished = self.slices >= self.slices_in_all
        return events

    def _start_block(self) -> None:
        """Evaluate the speaker's motion for the next BLOCK slices; it starts exactly where the last block ended."""
        vertices = self.slices * self._pieces + np.arange(BLOCK * self._pieces + 1)
        self._block = self._motion(vertices / (1000.0 * self._pieces))
        for column, now in zip(self._block, self._now, strict=True):
            column[0] = now

    def _motion(self, time_s: Floats) -> SpeakerMotion:
        """Return the speaker's motion at some times."""
        pressed = np.clip((time_s - self._time.rest_s) / self._press_s, 0.0, 1.0)
        force_n = self._press_n * (0.5 - 0.5 * np.cos(np.pi * pressed))
        since_s = time_s - self._time.tone_at_s
        sounding = np.clip(np.minimum(since_s, self._time.tone_s - since_s) / FADE_S, 0.0, 1.0)
        amplitude_m = self._amplitude_m * (0.5 - 0.5 * np.cos(np.pi * sounding))
        h2, m = (
            np.where(sounding > 0.0, drift.at(since_s), 0.0) for drift in (self._second_harmonic, self._modulation)
        )
        turns = np.exp(2j * np.pi * self._hz * ORDERS * since_s[:, None])
        moving = waves(h2, m, self.sampled.subharmonic_phase_rad) * turns * amplitude_m[:, None]
        depth_m = force_n * self._depth_m_n + moving.sum(axis=1).real
        return SpeakerMotion(force_n, depth_m, (moving @ self._along).real, amplitude_m, h2, m)

    def truth(self) -> dict[str, Any]:
        """Return the ground truth at the end of the last slice, by schema path."""
        return {
            "truth/dot_xy_px": self.gel_camera.dot_xy_px.astype(np.float32),
            "truth/object_xy_px": self.gel_camera.object_xy_px.astype(np.float32),
            **NO_SLIP,
            "truth/normal_force_n": self._now.force_n,
            "truth/shear_force_n": -self._shear_n_m * self._now.along_m,
            "truth/tone_hz": self._hz if self._now.amplitude_m > 0.0 else 0.0,
            "truth/tone_amplitude_um": self._now.amplitude_m * 1e6,
            "truth/tone_second_harmonic": self._now.second_harmonic,
            "truth/tone_modulation": self._now.modulation,
        }
