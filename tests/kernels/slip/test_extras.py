"""What a detector is told beside the dots: by hand, unknown, left out, and the same live as over a file."""

import numpy as np
import torch
from numpy.typing import NDArray

from evetac_cli.kernels.slip import inputs, networks, onnx_graphs, sampling, training
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    EXTRAS,
    ChannelView,
    DotArchitecture,
    ExtraView,
)
from evetac_cli.kernels.slip.detector import Detector, LiveDetector
from tests.kernels.slip.test_detector import WINDOW, events_about_rims, make_series, started

GRIP = ARCHITECTURES["disp-xy-grip"]
assert isinstance(GRIP, DotArchitecture)
PLACES = inputs.extra_inputs(GRIP)


def told(slices: int) -> NDArray[np.float32]:
    """Fingers that open, a command that comes later than they were first known, and a share that is known now and then.

    Commands are unknown for the first 20 slices, the share in every slice of the second half.
    """
    rng = np.random.default_rng(8)
    position = 300 - np.arange(slices) // 7
    goal = np.where(np.arange(slices) < 20, np.nan, 310.0 - np.arange(slices) // 5)
    share = np.where(np.arange(slices) < slices // 2, rng.random(slices), np.nan)
    return np.stack([position, goal, share], axis=1).astype(np.float32)


def network() -> Detector:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        built = networks.build(GRIP)
    return Detector(networks.onnx_graph(built), GRIP)


def test_views_by_hand() -> None:
    """Assert that a view gives whether it is known, the newest value, and changes since; all 0 where one is unknown."""
    view = ExtraView("sticking", newest=True, changes_ms=(1, 3))
    row = DotArchitecture("", (ChannelView("events", 1),), 1, 1, extras=(ExtraView("position", changes_ms=(2,)), view))
    assert (row.history, row.own_inputs, row.inputs_per_dot) == (4, 1, 1 + 2 + 4)
    series = np.full((6, len(EXTRAS)), np.nan, np.float32)
    series[:, 0] = [100, 100, 101, 103, 90, 60]
    series[1:, 2] = [0.5, 0.75, 0.5, 0.25, 1.0]
    dots = np.arange(6 * 2 * 4, dtype=np.float32).reshape(6, 2, 4)
    result = inputs.at(row, inputs.DotsAndExtras(dots, series), np.array([3, 4, 5]))
    assert result[:, 0, 1:].tolist() == [
        [1, 3, 0, 0, 0, 0],  # the share 3 ms before is not known
        [1, -inputs.MOST_CHANGE, 1, 0.25, -0.25, -0.25],
        [1, -inputs.MOST_CHANGE, 1, 1.0, 0.75, 0.25],
    ]
    np.testing.assert_array_equal(result[:, 0, 1:], result[:, 1, 1:])
    np.testing.assert_array_equal(result[..., 0], dots[3:, :, 1])


def test_live_is_over_with_extras() -> None:
    """Assert that a detector that is told as the slices come has the bits of one that is given all at once."""
    detector, slices = network(), 120
    known, dots = told(slices), make_series("disp-xy-grip", slices)
    assert isinstance(dots, np.ndarray)
    offline = detector.over(inputs.DotsAndExtras(dots, known))
    live = LiveDetector(detector, started(), WINDOW)
    online = np.empty(slices, np.float32)
    for k, events in enumerate(events_about_rims(slices)):
        live.tell(*(float(value) for value in known[k]))
        online[k] = live.step(*events)
    np.testing.assert_array_equal(online, offline)
    assert np.nanmax(np.abs(offline - detector.over(dots))) > 1e-4  # it makes a difference


def test_never_told_is_all_unknown() -> None:
    """Assert that a detector does without: features without extras are those with none known, live as well."""
    detector, slices = network(), 70
    dots = make_series("disp-xy-grip", slices)
    assert isinstance(dots, np.ndarray)
    offline = detector.over(inputs.DotsAndExtras(dots, np.full((slices, len(EXTRAS)), np.nan, np.float32)))
    np.testing.assert_array_equal(detector.over(dots), offline)
    live = LiveDetector(detector, started(), WINDOW)
    online = [live.step(*events) for events in events_about_rims(slices)]
    np.testing.assert_array_equal(np.array(online, np.float32), offline)


def test_what_is_left_out_is_as_if_never_known() -> None:
    """Assert that leaving out the gripper, or what sticks, gives the inputs of a series in which it is unknown."""
    slices = 130
    known, dots = told(slices), make_series("disp-xy-grip", slices)
    assert isinstance(dots, np.ndarray)
    at = np.full(4, 60)
    batch = inputs.at(GRIP, inputs.DotsAndExtras(dots, known), at)
    inputs.leave_out_extras(GRIP, batch, np.array([[False, False], [True, False], [False, True], [True, True]]))
    for sample, gone in enumerate(([], [0, 1], [2], [0, 1, 2])):
        less = known.copy()
        less[:, gone] = np.nan
        np.testing.assert_array_equal(batch[sample], inputs.at(GRIP, inputs.DotsAndExtras(dots, less), at)[0])


def test_what_was_never_known_is_not_learned() -> None:
    """Assert that a network trained without the share that sticks, or without all extras, does not see them later."""
    rng = np.random.default_rng(0)
    label, outside = (np.arange(120) >= 90).astype(np.int8), np.full(120, 30, np.int32)
    dots = rng.normal(0, 1, (120, 56, 4)).astype(np.float32)
    known = rng.normal(0, 1, (120, 3)).astype(np.float32)
    known[:, 2] = np.nan
    for series, learned in ((inputs.DotsAndExtras(dots, known), ("position", "command")), (dots, ())):
        samples = sampling.gather([inputs.Trajectory(series, outside, label, 90)], GRIP)
        for preset in ("adamw", "paper"):
            result = training.train(samples, training.PRESETS[preset], np.random.default_rng(1), max_steps=2)
            detector = Detector(onnx_graphs.build(GRIP, result.checkpoints[-1].weights), GRIP)
            assert detector.learned_extras == learned
            more = known.copy()
            more[:, 2] = 0.5
            seen = known if learned else np.full_like(known, np.nan)
            with_share = detector.over(inputs.DotsAndExtras(dots, more))
            np.testing.assert_array_equal(with_share, detector.over(inputs.DotsAndExtras(dots, seen)))


def test_turns_leave_extras_and_factors_scale_changes_in_ticks() -> None:
    """Assert that dots of a turned sample are told the same, changes in ticks multiplied, flags and shares not."""
    dots = make_series("disp-xy-grip", 60)
    assert isinstance(dots, np.ndarray)
    batch = inputs.at(GRIP, inputs.DotsAndExtras(dots, told(60)[:, :]), np.array([59]))
    batch[:, :, PLACES["sticking"]] = [1, 0.7, 0.1, 0.2]
    turned = inputs.turn(GRIP, batch, 7, 8, np.array([1]), np.array([0.5], np.float32))
    for extra in ("position", "command"):
        place = PLACES[extra]
        np.testing.assert_array_equal(turned[0, :, place.start], batch[0, :, place.start])
        changes = slice(place.start + 1, place.stop)
        np.testing.assert_array_equal(turned[0, :, changes], 0.5 * batch[0, :, changes])
    np.testing.assert_array_equal(turned[..., PLACES["sticking"]], batch[..., PLACES["sticking"]])


def test_a_slice_is_told_what_was_known_when_it_began() -> None:
    """Assert that a reading at a slice's start counts for it and a later one for the next, and none comes first."""
    t_us = np.array([1000, 2000, 3999, 4000])
    known = inputs.known_at_start(t_us, np.array([7, 8, 9, 10], np.int32), 6)
    np.testing.assert_array_equal(known, [np.nan, 7, 8, 8, 10, 10])
    assert np.isnan(inputs.known_at_start(t_us[:0], np.empty(0), 2)).all()


def test_goals_in_ticks_and_in_ma_are_one_command() -> None:
    """Assert that a goal current is told as ticks."""
    ticks, current = np.array([300, np.nan, np.nan], np.float32), np.array([np.nan, 60, np.nan], np.float32)
    told = inputs.extra_columns(3, goal_ticks=ticks, goal_ma=current)
    np.testing.assert_array_equal(told[:, 1], [300, 60 * inputs.TICKS_PER_MA, np.nan])
    assert np.isnan(told[:, [0, 2]]).all()
