"""Sticking share slice by slice: its reference, its alarm, its direction, and what a network must be."""

import math

import numpy as np
import pytest

from evetac_cli.kernels.touch import sticking
from evetac_cli.kernels.touch.rest import BLOCK_MS, REST_MS
from evetac_cli.kernels.touch.sticking import (
    INPUTS,
    PATIENCE,
    StickingNetwork,
    StickingReading,
    StickingState,
)

DOTS = np.stack(np.meshgrid(np.linspace(-8, 6, 8), np.linspace(-6, 6, 7)), -1).reshape(-1, 2)
NONE_LOST = np.zeros(len(DOTS), np.bool_)
PRESSED = DOTS * (1 + 0.02 * np.exp(-(DOTS**2).sum(axis=1, keepdims=True) / 50))  # moved outwards by a touch


def network(slip: float = 0.5, seed: int | None = None) -> StickingNetwork:
    """A network that says one slip share of all, or with a seed one with random weights."""
    shapes = ((INPUTS, 6), (6,), (6, 4), (4,), (4, 2))
    rng = np.random.default_rng(seed)
    weights = [np.zeros(shape) if seed is None else rng.normal(size=shape) for shape in shapes]
    odds = np.repeat(math.log(slip / (1 - slip)), 2)
    return StickingNetwork(*(each.astype(np.float32) for each in (*weights, odds, np.linspace(0.0, 0.5, 6))))


def readings(
    state: StickingState, slices: list[np.ndarray], touches: bool = True, lost: np.ndarray = NONE_LOST
) -> list[StickingReading]:
    """What each slice tells."""
    return [sticking.step(state, dots, lost, touches) for dots in slices]


def sheared(by_mm: float, towards_rad: float = 0.0) -> np.ndarray:
    """The pressed dots, dragged along about the middle."""
    weight = np.exp(-(DOTS**2).sum(axis=1, keepdims=True) / 30)
    return PRESSED + by_mm * weight * [math.cos(towards_rad), math.sin(towards_rad)]


def test_nothing_is_told_without_a_touch() -> None:
    """Assert NaN, no reference and no alarm while nothing touches, also after a touch with an alarm."""
    state = sticking.start(DOTS, network(0.9))
    readings(state, [DOTS] * 20, touches=False)
    assert readings(state, [PRESSED] * 50)[-1].alarm
    (gone,) = readings(state, [DOTS], touches=False)
    assert np.isnan(gone[:3]).all() and gone.reference_slice == -1 and not gone.alarm


def test_the_reference_is_that_of_the_last_rest() -> None:
    """Assert that changes count from first touch, then from each rest, and that a push in between renews nothing."""
    state = sticking.start(DOTS, network())
    readings(state, [DOTS] * 12, touches=False)
    first = readings(state, [PRESSED] * 50)
    assert {one.reference_slice for one in first} == {12}
    assert np.array_equal(state.reference_mm, DOTS)  # the block before
    rested = readings(state, [PRESSED] * REST_MS)[-1].reference_slice
    assert 12 + REST_MS - BLOCK_MS <= rested <= 12 + REST_MS + 2 * BLOCK_MS
    assert state.reference_mm == pytest.approx(PRESSED)
    pushed = readings(state, [sheared(0.1)] * (REST_MS // 2))
    assert {one.reference_slice for one in pushed} == {rested}
    readings(state, [sheared(0.1)] * REST_MS)
    assert state.reference_mm == pytest.approx(sheared(0.1))


def test_inputs_are_relative_to_the_displacement() -> None:
    """Assert that twice the displacement gives the same inputs, but for the one that says how large it is."""
    inputs = []
    for factor in (1.0, 2.0):
        state = sticking.start(DOTS, network())
        for dots in ([DOTS] * 10, [PRESSED] * 300, [sheared(0.2)] * 35):
            readings(state, [DOTS + factor * (one - DOTS) for one in dots])
        inputs.append(state.inputs.copy())
    assert inputs[0][:-1] == pytest.approx(inputs[1][:-1], abs=1e-5) and np.abs(inputs[0][:-1]).max() > 0.5
    assert inputs[1][-1] - inputs[0][-1] == pytest.approx(math.log(2), abs=1e-5)


def test_an_alarm_needs_patience() -> None:
    """Assert that an alarm comes with the PATIENCE-th look in a row that sees slip, and never where all sticks."""
    told = readings(sticking.start(DOTS, network(0.9)), [PRESSED] * 50)
    assert [one.alarm for one in told].index(True) == PATIENCE * BLOCK_MS - 1
    assert told[-1].sticking_share == pytest.approx(0.1) and told[-1].sticking_share_sd == pytest.approx(0.05)
    assert not any(one.alarm for one in readings(sticking.start(DOTS, network(0.01)), [PRESSED] * 50))


@pytest.mark.parametrize("towards_rad", [-2.5, 0.0, 1.2])
def test_slip_has_the_direction_of_the_drag(towards_rad: float) -> None:
    """Assert the direction within 0.1 rad where a part slips, and none where all sticks."""
    dots = [sheared(0.3, towards_rad)] * 20
    told = readings(sticking.start(DOTS, network(0.5)), dots)[-1].slip_direction_rad
    assert told == pytest.approx(towards_rad, abs=0.1)
    assert math.isnan(readings(sticking.start(DOTS, network(0.01)), dots)[-1].slip_direction_rad)


def test_any_grid_tells_about_the_same() -> None:
    """Assert that the same field of other dots, some missing or lost and astray, gives about the same inputs."""

    def inputs(dots: np.ndarray, lost: np.ndarray) -> np.ndarray:
        def at(by_mm: float) -> np.ndarray:
            astray = np.where(lost, 5.0, 0.0)[:, None]
            return dots + by_mm * np.exp(-(dots**2).sum(axis=1, keepdims=True) / 60) * [1.0, 0.3] + astray

        state = sticking.start(dots, network())
        readings(state, [at(0.0)] * 10 + [at(0.1)] * 300 + [at(0.15)] * 5, lost=lost)
        return state.inputs[:-1]

    usual = inputs(DOTS, NONE_LOST)
    lost = NONE_LOST.copy()
    lost[[3, 20, 30]] = True
    missing = DOTS.copy()
    missing[[10, 40]] = np.nan
    finer = np.stack(np.meshgrid(np.linspace(-8, 6, 12), np.linspace(-6, 6, 10)), -1).reshape(-1, 2)
    for dots, gone in ((DOTS, lost), (missing, NONE_LOST), (finer, np.zeros(len(finer), np.bool_))):
        other = inputs(dots, gone)
        assert np.isfinite(other).all() and np.corrcoef(usual, other)[0, 1] > 0.97
    state = sticking.start(DOTS, network())
    told = readings(state, [PRESSED] * 20, lost=np.arange(len(DOTS)) > 2)
    assert np.isnan(told[-1].sticking_share)  # three dots tell nothing


def test_a_network_is_what_its_weights_say() -> None:
    """Assert the share and probability of a random network against the products written out, also of wild inputs."""
    one = network(0.3, seed=5)
    inputs = np.random.default_rng(6).normal(size=INPUTS).astype(np.float32)
    wide = np.maximum(inputs @ one.first + one.first_bias, 0)
    odds = np.maximum(wide @ one.second + one.second_bias, 0) @ one.third + one.third_bias
    assert sticking.slip_estimate(one, inputs) == pytest.approx(1 / (1 + np.exp(-np.clip(odds, -30, 30))), abs=1e-5)
    assert all(0.0 <= said <= 1.0 for said in sticking.slip_estimate(one, np.full(INPUTS, 1e30, np.float32)))
