"""The camera behind a gel: its dots at rest, its window and cut edge if any, and its view of an object.

Three tables of a scene belong to the camera: `light` (see scanning/light), `vanishing_dots` and `calibration`.

The lens may distort, radially about the middle of the frame. A point at distance r from the middle is seen at
r (1 + k1 r^2 + k2 r^4); the frame's corners are at r = 1. Negative coefficients give barrel distortion, positive ones
pincushion distortion. Dots, the cut edge and the middle of an outline are moved to their distorted positions. Not
simulated: dots and outlines keep their shape, and a texture moves like the middle of its window.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import contact_edges
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.low_pass import LowPass, light_at, rim_bandwidth
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.setup.scene import Scene, VanishingDots
from evetac_cli.sim.setup.sensor import Sensor

CUT_NODES = 13  # points along the cut edge at which the gel's displacement is needed
FARTHEST_CUT_PX = 4.0  # largest distance of the cut edge's ends from the window's border
CUT_STEP_PX = 1e-3  # the cut edge is redrawn after it has moved by more: a level has then changed by 2e-4
FAINTEST = 0.2  # least radius and contrast of a dot, relative to the mean
AWAY_PX = 100.0  # distance outside the frame to which a vanished dot is moved; larger than any ring
FARTHEST = 1.1  # distances must grow up to here, as a multiple of a corner's distance
NEVER_HZ = (0.0, 0.0)  # rates of hot pixels for a sensor without any


@dataclass(frozen=True)
class Lens:
    """A lens in front of a frame of (width, height); ValueError if it would show a point twice."""

    frame_px: tuple[int, int]
    k1: float
    k2: float

    def __post_init__(self) -> None:
        r2 = np.linspace(0.0, FARTHEST, 200) ** 2
        if not (1.0 + 3.0 * self.k1 * r2 + 5.0 * self.k2 * r2**2 > 0.0).all():
            raise ValueError(f"distortion: expected seen distances that grow with distance, found {self.k1}, {self.k2}")

    @classmethod
    def of_sensor(cls, sensor: Sensor) -> "Lens | None":
        """Return the lens of a sensor; None without distortion."""
        k1, k2 = sensor.distortion
        return cls(sensor.frame_px, k1, k2) if k1 or k2 else None

    def seen(self, xy_px: ArrayLike) -> Floats:
        """Return the positions at which points (..., 2) are seen."""
        points = np.ascontiguousarray(xy_px, np.float64)
        width, height = self.frame_px
        seen: Floats = _seen(points.reshape(-1, 2), 0.5 * width, 0.5 * height, self.k1, self.k2)
        return seen.reshape(points.shape)

    def seen_line(self, x_px: Floats) -> Floats:
        """Return the positions (height,) in every row at which a line at x_px (height,) is seen."""
        height = len(x_px)
        beyond = height // 4
        rows = np.arange(-beyond, height + beyond, dtype=np.float64)
        points = self.seen(np.stack([np.pad(x_px, beyond, mode="edge"), rows], axis=1))
        return np.interp(np.arange(height, dtype=np.float64), points[:, 1], points[:, 0])


@njit(cache=True)
def _seen(xy_px: Floats, middle_x: float, middle_y: float, k1: float, k2: float) -> Floats:
    seen = np.empty_like(xy_px)
    corner2 = middle_x * middle_x + middle_y * middle_y
    for point in range(len(xy_px)):
        across = xy_px[point, 0] - middle_x
        down = xy_px[point, 1] - middle_y
        r2 = min((across * across + down * down) / corner2, FARTHEST * FARTHEST)
        factor = 1.0 + r2 * (k1 + r2 * k2)
        seen[point, 0] = middle_x + across * factor
        seen[point, 1] = middle_y + down * factor
    return seen


def dot_grid(sensor: Sensor, cut: bool) -> Floats:
    """Return the dot centres at rest, (rows, columns, 2) in px: the sensor's grid, rotated, with its jitter.

    A cut gel lacks the columns that the window removes. A sensor may list the position of every dot instead; dots
    without a grid form one row, of which a cut gel lacks the dots that the window touches.
    """
    if sensor.dot_xy_px:
        dot_xy_px = np.array(sensor.dot_xy_px, np.float64)
        return dot_xy_px[:, _beside_window(dot_xy_px, sensor)] if cut else dot_xy_px
    columns, rows = sensor.dot_columns_px, sensor.dot_rows_px
    rng = np.random.default_rng(sensor.seed)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    grid = _turned(grid + rng.normal(0.0, sensor.dot_jitter_px, grid.shape), sensor, sensor.turned_deg)
    return grid[:, _beside_window(grid, sensor)] if cut else grid


def _turned(grid: Floats, sensor: Sensor, angle_deg: float) -> Floats:
    """Return positions (..., 2) in px, rotated about the middle of the frame."""
    angle, middle = np.deg2rad(angle_deg), np.array(sensor.frame_px) / 2
    turned: Floats = (grid - middle) @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return turned + middle


def _beside_window(grid: Floats, sensor: Sensor) -> NDArray[np.bool_]:
    beside: NDArray[np.bool_] = grid[..., 0].max(axis=0) + sensor.dot_radius_px < sensor.window_px[0]
    return beside


def dots_differ(sensor: Sensor, cut: bool) -> tuple[Floats, Floats] | None:
    """Return factors on the radius and the log contrast of every dot (dots,), or None if dots are alike.

    They are drawn from the sensor's seed, with standard deviations dot_radius_spread and dot_contrast_spread, limited
    to three standard deviations and to FAINTEST.
    """
    spreads = sensor.dot_radius_spread, sensor.dot_contrast_spread
    if not any(spreads):
        return None
    grid = dot_grid(sensor, cut=False)
    deviations = np.random.default_rng([sensor.seed, 3]).standard_normal((2, *grid.shape[:2])).clip(-3.0, 3.0)
    if cut:
        deviations = deviations[:, :, _beside_window(grid, sensor)]
    radii, contrasts = np.maximum(1.0 + np.array(spreads)[:, None] * deviations.reshape(2, -1), FAINTEST)
    return radii, contrasts


@njit(cache=True)
def _moved_cut(cut_x_px: Floats, node_rows: Floats, cut_m: Floats, mm_per_px: float) -> Floats:
    """Return the cut edge's position in every row after the gel at its nodes (nodes, 2) has moved by cut_m.

    Linear between nodes, which are at rising rows. The result equals numpy.interp to the bit; numpy.interp took as long
    as all the rest of placing the lines.
    """
    moved = np.empty_like(cut_x_px)
    node = 0
    for row in range(len(cut_x_px)):
        while node + 2 < len(node_rows) and node_rows[node + 1] <= row:
            node += 1
        left_px = cut_m[node, 0] * 1e3 / mm_per_px
        right_px = cut_m[node + 1, 0] * 1e3 / mm_per_px
        slope = (right_px - left_px) / (node_rows[node + 1] - node_rows[node])
        moved_px = slope * (row - node_rows[node]) + left_px
        moved[row] = cut_x_px[row] + (right_px if row == node_rows[node + 1] else moved_px)
    return moved


class GelCamera:
    """A camera that views the dots, and an object through the window."""

    def __init__(
        self,
        sensor: Sensor,
        scene: Scene,
        texture: NDArray[np.float32] | None,
        rng: np.random.Generator,
        outline: contact_edges.Outline | None = None,
        outline_at_px: Floats | None = None,
    ) -> None:
        """Start the sensor's camera.

        `outline` is that of an object that indents the gel; its middle is at `outline_at_px` (x, y) when the object is
        not displaced. The caller moves the cut edge with the gel at `cut_rest_m` (CUT_NODES, 2), which is empty if no
        cut edge is visible.
        """
        cut = scene.gel.cut
        self._lens = Lens.of_sensor(sensor)
        self._flat_xy_px = dot_grid(sensor, cut)  # without the lens
        self.grid_xy_px = self._flat_xy_px if self._lens is None else self._lens.seen(self._flat_xy_px)
        self.calibrated_grid_xy_px, off = self.grid_xy_px, scene.calibration
        if off is not None:
            self.calibrated_grid_xy_px = _turned(self.grid_xy_px, sensor, off.turned_deg) + np.array(off.offset_px)
        self._gone, self._gone_from_us = self._vanishing(scene.vanishing_dots)
        self.window_px = sensor.window_px if cut else None
        self.mm_per_px = sensor.mm_per_px
        frame = np.array(sensor.frame_px)
        self.rest_m = (self._flat_xy_px.reshape(-1, 2) - frame / 2) * self.mm_per_px * 1e-3
        model = camera.CameraModel(
            frame_px=sensor.frame_px,
            scans_per_ms=scene.solver.scans_per_ms,
            threshold=sensor.threshold,
            threshold_off=sensor.threshold_off,
            mismatch=sensor.mismatch,
            noise_rate_hz=sensor.noise_hz,
            hot_pixels=sensor.hot_pixels,
            hot_rate_hz=sensor.hot_pixel_hz or NEVER_HZ,
            noise_on_share=sensor.noise_on_share,
            timestamp_step_us=sensor.timestamp_step_us,
            hot_pixel_table=sensor.hot_pixel_table,
            edge_sigma_px=sensor.edge_sigma_px,
            log_contrast=sensor.log_contrast,
            dot_radius_px=sensor.dot_radius_px,
            leak_hz=sensor.leak_hz,
            refractory_us=sensor.refractory_us,
            events_per_s=None if sensor.readout is None else sensor.readout.events_per_s,
            support_ms=None if sensor.noise_filter is None else sensor.noise_filter.support_ms,
        )
        self._rng = rng
        self._texture_at_px = rng.uniform(0, texture.shape[0], 2) if texture is not None else np.zeros(2)
        self.dot_xy_px = self.grid_xy_px.reshape(-1, 2).copy()
        self.object_xy_px = np.zeros(2)
        self._looked_at_rest = False
        self._lagging = None
        if sensor.bandwidth_hz:
            dots_hz, object_hz = self._bandwidths(sensor)
            self._lagging = LowPass(dots_hz, self.dot_xy_px), LowPass(object_hz, self.object_xy_px[None])
        window = None if texture is None or self.window_px is None else (self.window_px, texture)
        built = np.random.default_rng([sensor.seed, 1])
        self._outline = outline
        self._outline_at_px = frame / 2 if outline_at_px is None else outline_at_px
        self._object_at_px = self._outline_at_px if outline else self._window_middle_px(sensor)
        if self._lens is not None:
            self._outline_at_px = self._lens.seen(self._outline_at_px)
        self._outline_half_px = 0.5 * (np.array(outline.picture.shape[::-1]) - 1.0) if outline else np.zeros(2)
        self._cut_x_px, self.cut_rest_m = self._cut_edge(sensor, cut)
        self._cut_m = np.zeros_like(self.cut_rest_m)
        self._cut_node_rows = np.linspace(0.0, len(self._cut_x_px) - 1.0, CUT_NODES)
        self._lines = None
        if outline is not None or len(self.cut_rest_m):
            self._place = self._place_at(self.object_xy_px, self._cut_m, 0.0)
            self._lined_at = self.object_xy_px
            line = (sensor.cut_contrast, sensor.cut_width_px)
            self._lines = contact_edges.start(model.frame_px, self._place, outline, *line)
        differ = dots_differ(sensor, cut)
        self._camera = camera.start(model, self.dot_xy_px, window, rng, built, self._lines, scene.light, differ)

    def _bandwidths(self, sensor: Sensor) -> tuple[float | Floats, float | Floats]:
        """Return the bandwidths of the pixels at each dot's rim, and of those in the window."""
        bandwidth_hz = sensor.bandwidth_hz
        if not sensor.is_slow_in_dark:
            return bandwidth_hz, bandwidth_hz
        places = self.dot_xy_px, self._window_middle_px(sensor)
        dots, window = (light_at(place, sensor.frame_px, sensor.light_gradient) for place in places)
        return bandwidth_hz * rim_bandwidth(sensor.log_contrast) * dots, bandwidth_hz * window

    def _window_middle_px(self, sensor: Sensor) -> Floats:
        x0, y0, x1, y1 = sensor.window_px
        return np.array([x0 + x1, y0 + y1]) / 2

    def _vanishing(self, vanishing: VanishingDots | None) -> tuple[NDArray[np.intp], float]:
        """Return which dots vanish (numbers, row by row) and when, in us; ValueError if there is no such dot."""
        if vanishing is None:
            return np.empty(0, np.intp), np.inf
        rows, columns = self.grid_xy_px.shape[:2]
        for row, column in vanishing.dots:
            if not (0 <= row < rows and 0 <= column < columns):
                raise ValueError(
                    f"vanishing_dots.dots: expected rows 0 to {rows - 1} and columns 0 to {columns - 1},"
                    f" found [{row}, {column}]"
                )
        numbers = [row * columns + column for row, column in vanishing.dots]
        return np.array(numbers, np.intp), vanishing.at_s * 1e6

    def _cut_edge(self, sensor: Sensor, cut: bool) -> tuple[Floats, Floats]:
        """Return the cut edge's position in every row at rest, in px, and the points on it in m that move with the gel.

        The cut is straight between two ends, each off the window's border by the sensor's jitter. Both are empty
        without a cut edge.
        """
        if not sensor.has_dark_cut(cut=cut):
            return np.zeros(0), np.zeros((0, 2))
        width, height = sensor.frame_px
        border_px = sensor.window_px[0]
        off_px = np.random.default_rng([sensor.seed, 2]).normal(0.0, sensor.cut_jitter_px, 2)
        ends_px = border_px + np.clip(off_px, -FARTHEST_CUT_PX, FARTHEST_CUT_PX)
        nodes_px = np.stack([np.full(CUT_NODES, float(border_px)), np.linspace(0.0, height - 1.0, CUT_NODES)], axis=1)
        rest_m: Floats = (nodes_px - np.array([width, height]) / 2) * self.mm_per_px * 1e-3
        return np.linspace(ends_px[0], ends_px[1], height), rest_m

    def _place_at(self, object_xy_px: Floats, cut_m: Floats, strength: float) -> contact_edges.EdgePlace:
        """Return the positions of contact edges and cut edge, for displacements of the object and the gel."""
        corner = np.zeros(2)
        if self._outline is not None:
            corner = self._outline_at_px + object_xy_px - self._outline_half_px
        cut_x = self._cut_x_px
        if len(cut_x):
            cut_x = _moved_cut(cut_x, self._cut_node_rows, cut_m, self.mm_per_px)
            if self._lens is not None:
                cut_x = self._lens.seen_line(cut_x)
        return contact_edges.EdgePlace(corner, strength, cut_x)

    @property
    def contact_edge_events(self) -> int:
        """Return the number of events in the last slice that only contact edges and cut edge caused."""
        return 0 if self._lines is None else self._lines.events

    def render(
        self,
        shift_m: Floats,
        object_m: Floats,
        contrast: float,
        t0_us: int,
        shift_path_m: Floats | None = None,
        *,
        cut_m: Floats | None = None,
        strength: float = 0.0,
        still: bool = False,
    ) -> Events:
        """Return the events of a slice; at its end the dots are displaced by shift_m (dots, 2), the object by object_m.

        Dots move on straight lines, or along shift_path_m (k + 1, dots, 2): their displacements at k + 1 equally spaced
        times, from the end of the last slice to shift_m.

        cut_m, of the shape of `cut_rest_m`, is the displacement of the gel at the cut edge at the end (none if left
        out). strength, 0 to 1, is the visibility of the object's outline.

        `still` means that all of these equal those of the slice before.
        """
        if still and self._looked_at_rest:
            return camera.step_still(self._camera, t0_us, self._rng)
        dots = self.seen_px(shift_m)
        path = None if shift_path_m is None else self.seen_px(shift_path_m)
        object_px = object_m * (1e3 / self.mm_per_px)
        if self._lens is not None:
            object_px = self._lens.seen(self._object_at_px + object_px) - self._lens.seen(self._object_at_px)
        begin = self.dot_xy_px if path is None else path[0]
        seen = (begin, dots, self.object_xy_px, object_px)
        if self._lagging is not None:
            path, seen = self._lag(np.stack([begin, dots]) if path is None else path, object_px)
        if t0_us >= self._gone_from_us:
            path, seen = self._without_gone(path, seen)
        ends = (seen[0], seen[1], self._texture_at_px + seen[2], self._texture_at_px + seen[3])
        lines = self._move_lines(seen[3], self._cut_m if cut_m is None else cut_m, strength)
        motion = SliceMotion(*ends, contrast, path, *lines)
        events = camera.step(self._camera, motion, t0_us, self._rng)
        self.dot_xy_px, self.object_xy_px = dots, object_px
        # the last scan of a slice is before its end: only after a slice at rest has the camera seen the final state
        self._looked_at_rest = still and self._is_settled and bool((dots == begin).all())
        return events

    def seen_px(self, shift_m: Floats) -> Floats:
        """Return the positions at which dots that are displaced by shift_m (..., dots, 2) are seen."""
        dots: Floats = self._flat_xy_px.reshape(-1, 2) + shift_m * (1e3 / self.mm_per_px)
        return dots if self._lens is None else self._lens.seen(dots)

    @property
    def _is_settled(self) -> bool:
        """Whether the camera's view stays the same if nothing moves; false with slow pixels or changing light."""
        lasts = self._gone_from_us == np.inf and self._lagging is None
        return self._camera.light is None and lasts

    def _without_gone(
        self, path: Floats | None, seen: tuple[Floats, Floats, Floats, Floats]
    ) -> tuple[Floats | None, tuple[Floats, Floats, Floats, Floats]]:
        """Return the path, and start and end of dots and object, with vanished dots moved out of the view."""
        away_px = self.grid_xy_px.reshape(-1, 2)[self._gone]
        away_px[:, 0] = -AWAY_PX
        begin, end = seen[0].copy(), seen[1].copy()
        begin[self._gone] = end[self._gone] = away_px
        if path is not None:
            path = path.copy()
            path[:, self._gone] = away_px
        return path, (begin, end, *seen[2:])

    def _move_lines(
        self, object_xy_px: Floats, cut_m: Floats, strength: float
    ) -> tuple[contact_edges.EdgePlace | None, contact_edges.EdgePlace | None]:
        """Return the lines' positions at the end of the last slice and of this one; None if there are no lines."""
        if self._lines is None:
            return None, None
        before = self._place
        still = self._outline is None or (strength == before.strength and (object_xy_px == self._lined_at).all())
        moved_m = contact_edges.farthest(cut_m.reshape(-1), self._cut_m.reshape(-1))
        if not still or moved_m * 1e3 > CUT_STEP_PX * self.mm_per_px:
            self._place = self._place_at(object_xy_px, cut_m, strength)
            self._cut_m, self._lined_at = cut_m, object_xy_px
        return before, self._place

    def _lag(self, path: Floats, object_px: Floats) -> tuple[Floats, tuple[Floats, Floats, Floats, Floats]]:
        """Return the dots' path, and start and end of dots and object, as pixels of finite bandwidth see them."""
        assert self._lagging is not None
        dots, objects = self._lagging
        path = dots.follow(path)
        object_path = objects.follow(np.stack([self.object_xy_px, object_px])[:, None])
        return path, (path[0], path[-1], object_path[0, 0], object_path[-1, 0])
