"""The camera in front of dots that another simulator moves: equal to evetac's own scenes, and smooth between steps."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from evetac_cli.arrays import Floats
from evetac_cli.errors import InputError
from evetac_cli.events import Events, concatenate
from evetac_cli.sim.simulated_camera import SeenSlice, SimulatedCamera
from evetac_cli.sim.touch_sensor import TouchSensor

REST_PX = np.stack(np.meshgrid(np.arange(80.0, 600.0, 60.0), np.arange(60.0, 440.0, 60.0)), axis=-1).reshape(-1, 2)
QUIET = 'name = "still"\nlike = "evetac"\nnoise_hz = 0.0\nhot_pixels = 0\n'


def camera(dots: Any = REST_PX, seed: int = 0, **options: Any) -> SimulatedCamera:
    return SimulatedCamera(dots, rng=np.random.default_rng(seed), **options)


def moved(times_s: Floats) -> Floats:
    """Dots that go to and fro, two times a second, by 3 px, (times, dots, 2)."""
    x_px = 3.0 * np.sin(4 * np.pi * times_s)
    return REST_PX + np.stack([x_px, 0.5 * x_px], axis=-1)[:, None]


def events_of(slices: Iterable[SeenSlice]) -> Events:
    return concatenate([one.events for one in slices])


def same(one: tuple[SeenSlice, ...], other: tuple[SeenSlice, ...]) -> bool:
    columns = zip(events_of(one), events_of(other), strict=True)
    return len(one) == len(other) and all(np.array_equal(first, second) for first, second in columns)


def test_events_are_those_of_the_native_sensor(tmp_path: Any) -> None:
    """Assert the same events from the true dots of a touch at 1 kHz as the gel's own camera makes, pixel by pixel."""
    own = tmp_path / "still.sensor.toml"
    own.write_text(QUIET)
    touched = TouchSensor(str(own), rng=np.random.default_rng(1), gel="closed", solver={"node_pitch_mm": 1.45})
    native: list[Events] = []
    dots = [touched.dot_xy_px.reshape(-1, 2)]
    for number in range(60):
        touch = touched.step(0.001, normal_n=0.1 * number, shear_n=(0.02 * number, 0.0))
        native += touch.slices
        dots.append(touch.dot_xy_px)
    ours = camera(dots[0], sensor=str(own)).play(np.arange(61) * 1e-3, np.stack(dots))
    first, second = concatenate(native), events_of(ours)
    assert len(native) == len(ours) and first.size > 1000
    assert second.size == pytest.approx(first.size, rel=0.01)
    for polarity in (0, 1):
        assert np.count_nonzero(second.p == polarity) == pytest.approx(np.count_nonzero(first.p == polarity), rel=0.02)


@pytest.mark.parametrize("times_s", [np.arange(61) / 60, np.arange(401) / 400, np.arange(3001) / 3000,
                                     np.cumsum(np.random.default_rng(3).uniform(2e-4, 0.03, 60))])  # fmt: skip
def test_step_and_play_are_the_same(times_s: Floats) -> None:
    """Assert that a motion given at once makes the events of one given step by step, at any rate, in order of time."""
    whole = camera().play(times_s, moved(times_s))
    one = camera()
    stepped: list[SeenSlice] = []
    for time_s, place in zip(times_s, moved(times_s), strict=True):
        stepped += one.step(float(time_s), place)
    stepped += one.finish()
    assert same(whole, tuple(stepped))
    assert len(whole) == int((times_s[-1] - times_s[0]) * 1000 + 1e-6)
    t_us = events_of(whole).t
    assert (np.diff(t_us) >= 0).all() and t_us[-1] < len(whole) * 1000
    assert same(camera().play(times_s + 100.0, moved(times_s)), whole)  # the first time is that of the first slice


def test_dots_follow_a_monotone_cubic() -> None:
    """Assert where dots are seen at the end of each slice: on scipy's curve through all steps of a 60 Hz simulator."""
    times_s = np.arange(31) / 60
    one = camera()
    seen = [slice_.dot_xy_px for step in zip(times_s, moved(times_s), strict=True) for slice_ in one.step(*step)]
    expected = PchipInterpolator(times_s, moved(times_s))((1 + np.arange(len(seen))) * 1e-3)
    np.testing.assert_allclose(seen, expected, atol=1e-9)
    assert len(seen) == 483
    assert len(one._times_ns) < 10  # it forgets what it does not need


def test_a_dot_at_rest_makes_no_event_before_it_moves(tmp_path: Any) -> None:
    """Assert that a jump at a step makes no events before that step begins, where a spline would swing."""
    own = tmp_path / "still.sensor.toml"
    own.write_text(QUIET)
    times_s = np.arange(8) / 60
    places = np.repeat(REST_PX[None], 8, axis=0)
    places[4:, :, 0] += 5.0
    sizes = [one.events.size for one in camera(sensor=str(own)).play(times_s, places)]
    assert sum(sizes[:50]) == 0 and sum(sizes[50:68]) > 1000 and sum(sizes[70:]) == 0


def test_millimetres_are_from_the_middle_of_the_view() -> None:
    """Assert equal events for the same dots in mm on the gel, and that any grid keeps its rows."""
    times_s = np.arange(31) / 60
    one = camera()
    in_mm = (moved(times_s) - np.array([320.0, 240.0])) * 0.0329
    other = camera(in_mm[0], unit="mm")
    np.testing.assert_allclose(other.dot_xy_px.reshape(-1, 2), moved(times_s)[0], atol=1e-9)
    count = events_of(one.play(times_s, moved(times_s))).size
    assert events_of(other.play(times_s, in_mm)).size == pytest.approx(count, rel=0.01)
    assert camera(REST_PX.reshape(7, 9, 2)).dot_xy_px.shape == (7, 9, 2)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: camera(unit="m"), "px or mm"),
        (lambda: camera(np.zeros((3, 3))), r"\(dots, 2\)"),
        (lambda: camera([[np.nan, 0.0]]), "finite"),
        (lambda: camera().step(0.0, REST_PX[1:]), "63 dots"),
        (lambda: camera().play([0.0, 0.0], [REST_PX, REST_PX]), "a time after 0 s"),
        (lambda: camera().play([0.0, np.inf], [REST_PX, REST_PX]), "a time within"),
        (lambda: camera().play([0.0], [REST_PX, REST_PX]), "as many times"),
    ],
)
def test_what_cannot_be_seen_is_refused(wrong: Any, message: str) -> None:
    """Assert what invalid dots, times and units are told."""
    with pytest.raises(InputError, match=message):
        wrong()
