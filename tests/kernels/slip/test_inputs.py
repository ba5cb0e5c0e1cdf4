"""Inputs of networks: the paper's formulas one by one, the same bits in any batch, and rotations."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels.slip import features, inputs
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    Architecture,
    DotArchitecture,
    ImageArchitecture,
)
from evetac_cli.kernels.slip.features import EventImages

DOTS = {name: row for name, row in ARCHITECTURES.items() if isinstance(row, DotArchitecture)}
SMALL = {name: row for name, row in ARCHITECTURES.items() if name in DOTS or name.endswith("-6x6")}


def dots(slices: int, n: int = 56, seed: int = 0) -> NDArray[np.float32]:
    """Random features of all channels."""
    return np.random.default_rng(seed).normal(0, 3, (slices, n, 2)).astype(np.float32)


def images(slices: int, seed: int = 0) -> EventImages:
    """Random event images with up to 300 pixels a slice."""
    rng = np.random.default_rng(seed)
    start = np.cumsum([0, *rng.integers(0, 300, slices)])
    pixel = np.concatenate([rng.choice(540 * 480, count, replace=False) for count in np.diff(start)] or [np.empty(0)])
    return EventImages(start, pixel.astype(np.uint32), rng.choice(np.array([-1, 1], np.int8), start[-1]))


def series_for(row: Architecture, slices: int, seed: int = 0) -> inputs.Series:
    """Random features of the sort that an architecture sees."""
    return images(slices, seed) if isinstance(row, ImageArchitecture) else dots(slices, seed=seed)


def quarter_turned(row: Architecture, batch: NDArray[np.float32], turns: int) -> NDArray[np.float32]:
    """All samples of a batch turned alike, and not multiplied."""
    return inputs.turn(row, batch, 7, 8, np.full(len(batch), turns), np.ones(len(batch), np.float32))


def by_the_paper(name: str, series: NDArray[np.float32], t: int) -> NDArray[np.float64]:
    """Inputs of the paper's table, written out: d and N of every dot at t, t - 1 and so on, and their means."""
    d, events = (series[:, :, channel].astype(np.float64) for channel in (0, 1))
    columns: dict[str, list[NDArray[np.float64]]] = {
        "no-hist": [d[t], events[t]],
        "hist10": [d[t - i] for i in range(10)] + [events[t - i] for i in range(10)],
        "events-only": [events[t - i] for i in range(10)],
        "disp-only": [d[t - i] for i in range(10)],
        "hist20": [d[t - i] for i in range(20)] + [events[t - i] for i in range(20)],
        "down5": [
            sum((0.2 * kind[t - 5 * block - i] for i in range(5)), np.zeros(56))
            for kind in (d, events)
            for block in range(10)
        ],
        "fast-slow": [
            column
            for kind in (d, events)
            for column in [
                *(kind[t - i] for i in range(10)),
                *(sum((0.1 * kind[t - 10 * block - i] for i in range(10)), np.zeros(56)) for block in range(5)),
            ]
        ],
    }
    return np.stack(columns[name], axis=-1)


@pytest.mark.parametrize("name", DOTS)
def test_inputs_are_the_papers(name: str) -> None:
    """Assert that each dot model sees what the paper's table of model configurations says, in its order."""
    series = dots(60)
    result = inputs.at(ARCHITECTURES[name], series, np.array([59, 52]))
    assert result.dtype == np.float32
    for row, t in zip(result, (59, 52), strict=True):
        np.testing.assert_allclose(row, by_the_paper(name, series, t), rtol=1e-5, atol=1e-5)


def test_images_by_hand() -> None:
    """Assert that image inputs are the last event images, newest first, and their sums over 6 x 6 px."""
    series = images(12)
    full = np.zeros((12, 480 * 540), np.float32)
    for t in range(12):
        part = series.part(t, t + 1)
        full[t, part.pixel] = part.sign
    full = full.reshape(12, 480, 540)
    result = inputs.at(ARCHITECTURES["hist10-img"], series, np.array([11, 9]))
    np.testing.assert_array_equal(result, np.stack([full[11:1:-1], full[9::-1]]))
    pooled = full.reshape(12, 80, 6, 90, 6).sum(axis=(2, 4))
    result = inputs.at(ARCHITECTURES["hist10-img-6x6"], series, np.array([11, 9]))
    np.testing.assert_array_equal(result, np.stack([pooled[11:1:-1], pooled[9::-1]]))


@pytest.mark.parametrize("row", SMALL.values(), ids=SMALL)
def test_inputs_do_not_depend_on_the_batch_nor_on_what_lies_around(row: Architecture) -> None:
    """Assert that a sample alone, in a series of its own, gives the bits it gives among others: offline is online."""
    series = series_for(row, row.history + 20)
    ends = np.arange(row.history - 1, row.history + 20)
    together = inputs.at(row, series, ends)
    for end, expected in zip(ends, together, strict=True):
        alone = inputs.part(series, int(end) - row.history + 1, int(end) + 1)
        assert inputs.length(alone) == row.history
        result = inputs.at(row, alone, np.array([row.history - 1]))
        assert result.tobytes() == expected.tobytes()


@pytest.mark.parametrize("row", SMALL.values(), ids=SMALL)
def test_series_are_cut_and_joined(row: Architecture) -> None:
    """Assert that parts of a series put end to end are the whole, and that parts are copies."""
    series = series_for(row, 9)
    joined = inputs.join(inputs.part(series, *ends) for ends in ((0, 1), (1, 4), (4, 4), (4, 9)))
    whole, again = ([part for part in one] if isinstance(one, EventImages) else [one] for one in (series, joined))
    for one, other in zip(whole, again, strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
        assert not np.shares_memory(one, other)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_turned_inputs_are_those_of_the_turned_grid(turns: int) -> None:
    """Assert that rotating inputs is what turning the gel would give."""
    row = ARCHITECTURES["fast-slow"]
    series = dots(100)
    result = quarter_turned(row, inputs.at(row, series, np.array([99])), turns)
    grid = features.rotate(series.reshape(100, 7, 8, 2), turns).reshape(100, 56, 2)
    np.testing.assert_array_equal(result, inputs.at(row, grid, np.array([99])))


def test_a_slice_has_what_was_known_when_it_began() -> None:
    """Assert that a reading at a slice's start counts for it and a later one for the next, and none comes first."""
    t_us = np.array([1000, 2000, 3999, 4000])
    known = inputs.known_at_start(t_us, np.array([7, 8, 9, 10], np.int32), 6)
    np.testing.assert_array_equal(known, [np.nan, 7, 8, 8, 10, 10])
    assert np.isnan(inputs.known_at_start(t_us[:0], np.empty(0), 2)).all()


@pytest.mark.parametrize("name", ["hist10", "fast-slow", "hist10-img-6x6"])
def test_quarter_turns_add_up_to_the_crop(name: str) -> None:
    """Assert that four quarter turns give back the middle square, and nothing beside it."""
    row = ARCHITECTURES[name]
    batch = inputs.at(row, series_for(row, 110), np.array([105, 109]))
    before = batch.copy()
    turned = batch
    for _ in range(4):
        turned = quarter_turned(row, turned, 1)
    np.testing.assert_array_equal(batch, before)
    if isinstance(row, ImageArchitecture):
        expected = np.zeros_like(batch)
        expected[..., 5:85] = batch[..., 5:85]
    else:
        grid = batch.reshape(2, 7, 8, -1).copy()
        grid[:, :, 0] = 0
        expected = grid.reshape(batch.shape)
    np.testing.assert_array_equal(turned, expected)
