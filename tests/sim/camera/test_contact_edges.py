"""Lines that are not dots: their shape, and the camera against every pixel compared in every scan."""

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.evaluate.cost.camera import match
from evetac_cli.events import Events, concatenate
from evetac_cli.sim.camera import contact_edges, optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.contact_edges import ContactEdges, EdgePlace
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState
from tests.sim.camera.small_frames import texture_level

pytestmark = pytest.mark.slow  # a minute of processor time

FRAME = (120, 90)
QUIET = CameraModel(frame_px=FRAME, noise_rate_hz=0.0, hot_pixels=0)
STRIP = (80, 10, 120, 80)
TEXTURE = optics.texture(np.random.default_rng(3), (128, 128), 10.0, 0.3)
NO_CUT = np.zeros(0)
FINGER = contact_edges.ellipse((50.0, 36.0), 0.5, 4.0)
CUT = (0.3, 3.0)
DOTS = np.array([[40.3, 40.6], [62.2, 47.7]])
STILL = (0.0, 0.0)

Motion = Callable[[float], tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]]


def place(x: float, y: float, strength: float = 1.0, cut: Any = NO_CUT) -> EdgePlace:
    """An outline's middle at (x, y)."""
    rows, columns = FINGER.picture.shape
    return EdgePlace(np.array([x - (columns - 1) / 2, y - (rows - 1) / 2]), strength, np.asarray(cut, np.float64))


def slide(t_ms: float) -> tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]:
    """Dots, texture, and a finger that crosses both the dots and the window, while the cut edge swings."""
    cut = 80.0 + 3.0 * math.sin(0.4 * t_ms) * np.linspace(-1, 1, FRAME[1])
    return DOTS + [0.4 * t_ms, 0.1 * t_ms], np.array([1.1 * t_ms, -0.4 * t_ms]), place(20 + 2.5 * t_ms, 45.0, 1.0, cut)


def touch(t_ms: float) -> tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]:
    """A finger that comes, stays and goes, over a dot that moves and one that does not."""
    strength = float(np.clip(min(t_ms, 26.0 - t_ms) / 8.0, 0.0, 1.0))
    return DOTS + [[0.1 * t_ms, 0.0], [0.0, 0.0]], np.zeros(2), place(48.0 + 0.2 * t_ms, 42.0, strength)


MOTIONS: dict[str, tuple[Motion, int]] = {"slide": (slide, 24), "touch": (touch, 26)}


def lines_for(motion: Motion) -> ContactEdges:
    return contact_edges.start(FRAME, motion(0)[2], FINGER, *CUT)


def start(motion: Motion, model: CameraModel = QUIET, *, window: bool = True) -> CameraState:
    strip = (STRIP, TEXTURE) if window else None
    rng = np.random.default_rng(0)
    return camera.start(model, motion(0)[0], strip, rng, None, lines_for(motion))


def play(state: Any, motion: Motion, slices: int) -> Events:
    """Events of a camera, slice after slice."""
    rng = np.random.default_rng(1)
    parts = []
    for k in range(slices):
        (dots, object_xy_px, begin), (dots_end, object_end_xy_px, end) = motion(k), motion(k + 1)
        moved = SliceMotion(dots, dots_end, object_xy_px, object_end_xy_px, 1.0, None, begin, end)
        parts.append(camera.step(state, moved, 1000 * k, rng))
    return concatenate(parts)


def between(motion: Motion, k: int, part: float) -> tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]:
    """What a camera is told within a slice: all moves evenly."""
    (dots, object_xy_px, begin), (dots_end, object_end_xy_px, end) = motion(k), motion(k + 1)
    mixed = [
        a + part * (b - a)
        for a, b in zip((dots, object_xy_px, *begin), (dots_end, object_end_xy_px, *end), strict=True)
    ]
    return mixed[0], mixed[1], EdgePlace(*mixed[2:])


def lines_level(where: EdgePlace) -> NDArray[np.float64]:
    """What the lines add to every pixel, from the tables' closed meaning."""
    y, x = np.mgrid[: FRAME[1], : FRAME[0]]
    picture = FINGER.picture.astype(float)
    at_x, at_y = x - where.corner_px[0], y - where.corner_px[1]
    column, row = np.floor(at_x).astype(int), np.floor(at_y).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < picture.shape[1] - 1) & (row < picture.shape[0] - 1)
    c, r = np.where(inside, column, 0), np.where(inside, row, 0)
    u, v = at_x - column, at_y - row
    upper = (1 - u) * picture[r, c] + u * picture[r, c + 1]
    lower = (1 - u) * picture[r + 1, c] + u * picture[r + 1, c + 1]
    level = np.where(inside, where.strength * ((1 - v) * upper + v * lower), 0.0)
    if len(where.cut_x_px):
        half = 0.5 * CUT[1] / math.sqrt(1 - math.sqrt(0.5))
        away = (x - where.cut_x_px[:, None]) / half
        level = level - CUT[0] * np.clip(1 - away**2, 0, None) ** 2
    return level


def picture(state: CameraState, motion: Motion, k: int, part: float) -> NDArray[np.float64]:
    """Dots or texture, and lines, of the whole frame."""
    dots, object_xy_px, where = between(motion, k, part)
    level = optics.gel_level(FRAME, dots, state.profile).astype(float)
    if state.window_reference.size:
        x0, y0, x1, y1 = STRIP
        level[y0:y1, x0:x1] = texture_level(TEXTURE, (y1 - y0, x1 - x0), (x0, y0), object_xy_px)
    return level + lines_level(where)


def references(state: CameraState, motion: Motion) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Absolute references and thresholds of all pixels when the camera is switched on."""
    reference, threshold = state.reference.astype(float), state.threshold.astype(float)
    if state.window_reference.size:
        x0, y0, x1, y1 = STRIP
        strip = texture_level(TEXTURE, (y1 - y0, x1 - x0), (x0, y0), STILL)
        reference[y0:y1, x0:x1] = state.window_reference + strip
        threshold[y0:y1, x0:x1] = state.window_threshold
    return reference + lines_level(motion(0)[2]), threshold


def every_pixel(state: CameraState, motion: Motion, slices: int) -> Events:
    """Events of a camera that compares the whole frame in every scan."""
    reference, threshold = references(state, motion)
    scans, width = state.model.scans_per_ms, FRAME[0]
    rows = []
    for k in range(slices):
        for scan in range(scans):
            level = picture(state, motion, k, scan / scans)
            change = level - reference
            fired = np.abs(change) >= threshold
            reference[fired] = level[fired]
            for y, x in np.argwhere(fired).tolist():
                t_us = math.floor(1000 * k + (scan + x / width) * 1000 / scans + 1e-9)
                rows.append((t_us, x, y, int(change[y, x] > 0)))
    return Events(*np.array(rows).T)


@pytest.mark.parametrize("window", [True, False])
@pytest.mark.parametrize("name", MOTIONS)
def test_scans_see_dots_lines_and_texture_together(name: str, window: bool) -> None:
    """Assert the events of every pixel in every scan, but for levels that move less than is looked at: within 1 %."""
    motion, slices = MOTIONS[name]
    state = start(motion, window=window)
    expected = every_pixel(copy.deepcopy(state), motion, slices)
    result = play(state, motion, slices)
    agreement = match(result, expected, 1.0)
    assert expected.t.size > 1000
    assert agreement.count_share == pytest.approx(0.0, abs=0.01)
    # A level looked at 0.005 late is one scan late: more often so where lines fade slowly than where they move.
    assert agreement.f1 >= (0.97 if name == "slide" else 0.85)
    assert match(result, expected, 1000.0).f1 >= 0.985


@pytest.mark.parametrize("speed", [0.002, 0.02, 0.3])
def test_pixels_that_are_left_out_would_not_have_fired(speed: float) -> None:
    """Assert the same events in the same order whether pixels of an outline are left out or, beside a window, are not.

    The outline comes, turns over dots that creep, drift or run, and goes; the window is in a corner and shows nothing.
    """
    grid = np.stack(np.meshgrid([22.3, 98.2], [20.1, 68.7]), axis=-1).reshape(-1, 2)
    away = np.random.default_rng(2).normal(0.0, 1.0, grid.shape)

    def turning(t_ms: float) -> tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]:
        middle = 60.0 + 25.0 * math.sin(0.2 * t_ms), 45.0 + 12.0 * math.cos(0.2 * t_ms)
        cut = 85.0 + 0.1 * t_ms * np.linspace(-1, 1, FRAME[1])
        return grid + speed * t_ms * away, np.zeros(2), place(*middle, min(0.2 * t_ms, 1.0, 0.2 * (40 - t_ms)), cut)

    nothing = np.zeros((8, 8), np.float32)
    states = [
        camera.start(QUIET, grid, window, np.random.default_rng(0), None, lines_for(turning))
        for window in (None, ((0, 88, 2, 90), nothing))
    ]
    few, every = (play(state, turning, 40) for state in states)
    assert few.size > 2000
    for name in few._fields:
        np.testing.assert_array_equal(getattr(few, name), getattr(every, name))


def test_still_lines_are_silent() -> None:
    """Assert that lines that rest make no event, not even when a dot moves far from them or the camera is new."""

    def motion(t_ms: float) -> tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]:
        return DOTS[:1], np.zeros(2), place(60.0, 45.0, 1.0, np.full(FRAME[1], 80.0))

    state = start(motion)
    assert play(state, motion, 5).size == 0
    assert state.contact_edges is not None
    assert state.contact_edges.events == 0


def test_cut_edge_shows_on_both_sides() -> None:
    """Assert that an edge that swings over the window's border makes events in gel and window, and all are its own."""

    def swing(t_ms: float) -> tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]:
        cut = np.full(FRAME[1], 80.0 + 6.0 * math.sin(0.3 * t_ms))
        return DOTS[:1], np.zeros(2), place(0.0, 0.0, 0.0, cut)

    state = start(swing)
    rng = np.random.default_rng(1)
    in_gel = in_window = 0
    for k in range(25):
        (dots, object_xy_px, begin), end = swing(k), swing(k + 1)[2]
        moved = SliceMotion(dots, dots, object_xy_px, object_xy_px, 1.0, None, begin, end)
        result = camera.step(state, moved, 1000 * k, rng)
        in_window += int((result.x >= STRIP[0]).sum())
        in_gel += int((result.x < STRIP[0]).sum())
        assert state.contact_edges is not None
        assert state.contact_edges.events == result.size
    assert min(in_gel, in_window) > 500


def test_count_of_a_passing_rim() -> None:
    """Assert the closed form: a full rise by n thresholds gives sum_k clip((n - k) / 2, 0, 1) events a pixel."""
    model = dataclasses.replace(QUIET, mismatch=0.0)
    rows, columns = FINGER.picture.shape
    top = float(FINGER.height)

    def rise(t_ms: float) -> tuple[NDArray[np.float64], NDArray[np.float64], EdgePlace]:
        return np.empty((0, 2)), np.zeros(2), place(60.0, 45.0, min(t_ms / 40.0, 1.0))

    result = play(start(rise, model, window=False), rise, 41)
    steps = FINGER.picture.astype(float).ravel() / model.threshold
    expected = sum(np.clip((steps - k) / 2, 0, 1).sum() for k in range(4))
    assert top == pytest.approx(0.5, abs=0.01)
    assert (rows, columns) <= (FRAME[1], FRAME[0])
    assert result.size == pytest.approx(expected, rel=0.06)


def test_ellipse_is_phi_of_the_depth() -> None:
    """Assert L = s Phi(d / w) on the axes of a finger, and for every pixel of a circle; a ring has two edges."""
    level, width = 0.5, 8.0
    for size in ((250.0, 180.0), (180.0, 250.0)):
        finger = contact_edges.ellipse(size, level, width)
        rows, columns = finger.picture.shape
        for axis, line in ((0, finger.picture[rows // 2]), (1, finger.picture[:, columns // 2])):
            place_px = np.abs(np.arange(len(line)) - len(line) // 2)
            # Near the middle of the long axis the nearest rim lies aside.
            outer = place_px > 0.45 * size[axis]
            depth = size[axis] / 2 - place_px[outer]
            phi = np.array([0.5 * math.erfc(-d / width / math.sqrt(2)) for d in depth])
            np.testing.assert_allclose(line[outer], level * phi, atol=3e-4)
    circle = contact_edges.ellipse((120.0, 120.0), level, width).picture
    y, x = np.mgrid[: circle.shape[0], : circle.shape[1]] - circle.shape[0] // 2
    phi = np.vectorize(lambda d: 0.5 * math.erfc(-d / width / math.sqrt(2)))(60.0 - np.hypot(x, y))
    np.testing.assert_allclose(circle, level * phi, atol=3e-4)
    ring = contact_edges.ellipse((260.0, 150.0), level, 8.0, 40.0).picture
    across = ring[ring.shape[0] // 2]
    assert np.count_nonzero(np.diff(across > 0.49 * level)) == 4


@pytest.mark.parametrize("change", [(0.0, 0.0), (0.7, 0.3), (-2.6, 1.9), (9.0, -14.0)])
@pytest.mark.parametrize("thick", [None, 9.0])
def test_every_pixel_that_changes_is_visited(change: tuple[float, float], thick: float | None) -> None:
    """Assert that pixels outside the runs have the same level before and after a move, of ellipse and ring."""
    outline = contact_edges.ellipse((90.0, 70.0), 0.5, 2.0, thick)
    before, after = (31.3, 12.8), (31.3 + change[0], 12.8 + change[1])
    lines = np.empty((2, 200), np.float32)
    visited = 0
    for y in range(120):
        for line, corner in zip(lines, (before, after), strict=True):
            contact_edges.sample_row(outline.picture, *corner, 1.0, y, 0, 200, line)
        inside = np.zeros(200, bool)
        left, left_end, right, right_end = contact_edges.outline_runs(
            outline.runs, outline.picture.shape[1], 200, y, *after, *before, False
        )
        inside[left:left_end] = inside[right:right_end] = True
        visited += int(inside.sum())
        assert np.abs(lines[1] - lines[0])[~inside].max(initial=0.0) < 1e-6
    if thick is None and abs(change[0]) < 3:
        assert visited < 0.7 * outline.picture.size


@pytest.mark.parametrize(
    ("size", "level", "width", "thick", "named"),
    [
        ((10.0, 10.0), -0.5, 8.0, None, "level"),
        ((10.0, 10.0), 0.5, math.inf, None, "width_px"),
        ((100.0, 60.0), 0.5, 8.0, 30.0, "thick_px"),
    ],
)
def test_ellipse_refuses(size: Any, level: float, width: float, thick: float | None, named: str) -> None:
    """Assert that an outline that cannot be drawn is refused."""
    with pytest.raises(ValueError, match=named):
        contact_edges.ellipse(size, level, width, thick)


@pytest.mark.parametrize(
    "where",
    [
        place(math.nan, 1.0),
        place(1.0, 2e6),
    ],
)
def test_step_refuses(where: EdgePlace | None) -> None:
    """Assert that a place that is not finite or out of range is refused, and the camera is as it was."""
    state = start(touch)
    before = state.reference.copy()
    dots = touch(0)[0]
    with pytest.raises(ValueError, match="contact_edges_end"):
        camera.step(
            state,
            SliceMotion(dots, dots + 1.0, STILL, STILL, 1.0, None, touch(0)[2], where),
            0,
            np.random.default_rng(0),
        )
    np.testing.assert_array_equal(state.reference, before)
