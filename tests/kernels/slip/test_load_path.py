"""The numbers of a contact: closed forms of single ones, and the same bits for a file and slice by slice."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.kernels.slip import load_path
from evetac_cli.kernels.slip.architectures import LOAD_PATH, OF_GRIPPER, SHEAR_MODULUS_PA, Sensitivity
from evetac_cli.kernels.slip.load_path import EVERY, MM_PER_PX, SMALL_MM, TOLD

SHAPE = (7, 8)
ROW, COLUMN = (axis.reshape(-1) for axis in np.meshgrid(np.arange(7.0), np.arange(8.0), indexing="ij"))
TOUCH = (math.nan, math.nan, math.nan, 0.75, 0.5)
NO_TOUCH = (math.nan,) * len(TOLD)
Told = tuple[float, ...]


def numbers(fields: NDArray[np.floating], told: Told | list[Told] = TOUCH, **started: object) -> dict[str, list[float]]:
    """The numbers by name for displacements (steps, 56, 2) that stay for a step, with an event of each dot a slice."""
    moved = np.repeat(fields, EVERY, axis=0).astype(np.float32)
    known = np.array(told if isinstance(told, list) else [told] * len(fields), np.float32)
    state = load_path.start(SHAPE, **started)  # type: ignore[arg-type]
    path = load_path.over(state, moved, np.ones(moved.shape[:2], np.int32), np.repeat(known, EVERY, axis=0))
    assert path.slices == len(moved) and len(path.numbers) == len(fields)
    assert np.isfinite(path.numbers).all()
    return {name: path.numbers[:, place].tolist() for place, name in enumerate(LOAD_PATH)}


def uniform(*x_px: float) -> NDArray[np.float64]:
    """All dots moved to the right, by this much in each step."""
    return np.stack([np.tile([x, 0.0], (56, 1)) for x in x_px])


def test_pure_shear() -> None:
    """Assert that dots that move alike have their displacement as size, which is the most so far, and are not bent."""
    found = numbers(np.tile([3.0, 4.0], (1, 56, 1)))
    mm = 5 * MM_PER_PX
    assert found["size"] == pytest.approx([math.log(mm / 0.1)], rel=1e-6)
    assert found["shear"] == pytest.approx([math.log(mm / 0.1 + 0.05)], rel=1e-6)
    assert found["of_most_shear"] == pytest.approx([mm / (mm + SMALL_MM)], rel=1e-6)
    assert found["bent"] == pytest.approx([0], abs=1e-6)
    assert found["events"] == pytest.approx([math.log1p(56 * EVERY / 50)], rel=1e-6)
    assert found["slip_share_odds"] == pytest.approx([math.log(1 / 3) / 3], rel=1e-6)
    assert found["slip_begun_odds"] == [0]
    assert [found[name] for name in LOAD_PATH[OF_GRIPPER]] == [[0]] * 6


def test_an_affine_field_is_not_bent() -> None:
    """Assert that stretch and turn leave nothing over, in any grid with holes, and a bend its whole deviation."""
    affine = np.stack([2 + 0.3 * ROW - 0.2 * COLUMN, 1 - 0.4 * ROW + 0.1 * COLUMN], axis=1)
    holes = affine.copy()
    holes[[0, 13, 14, 55]] = 0
    assert numbers(np.stack([affine]))["bent"] == pytest.approx([0], abs=1e-6)
    assert numbers(np.stack([holes]))["bent"] == pytest.approx([0], abs=1e-6)
    bend = np.stack(
        [(ROW - 3) ** 2 - 4, np.ones(56)], axis=1
    )  # right it has neither mean nor slope, and a square of 12
    found = numbers(np.stack([bend]))
    assert found["bent"] == pytest.approx([math.sqrt(12 / 13)], rel=1e-6)
    assert found["size"] == pytest.approx([math.log(MM_PER_PX * math.sqrt(13) / 0.1)], rel=1e-6)


def test_a_missing_dot_is_left_out() -> None:
    """Assert that dots that never moved leave the means as they are, and one that returns to rest counts on."""
    field = uniform(4.0, 4.0)
    field[:, :7] = 0
    assert numbers(field)["size"] == pytest.approx(numbers(uniform(4.0, 4.0))["size"])
    assert numbers(field)["bent"] == pytest.approx([0, 0], abs=1e-6)
    back = uniform(4.0, 4.0)
    back[1, :28] = 0
    assert numbers(back)["size"][1] == pytest.approx(math.log(4 * MM_PER_PX * math.sqrt(0.5) / 0.1))


def test_the_most_shear_is_that_of_the_contact() -> None:
    """Assert that shear is compared with the largest so far, which is forgotten when nothing touches."""
    told = [TOUCH, TOUCH, TOUCH, NO_TOUCH, TOUCH]
    found = numbers(uniform(2, 8, 4, 8, 4), told)["of_most_shear"]
    mm = np.array([2, 8, 4, 8, 4]) * MM_PER_PX
    most = np.array([2, 8, 8, 0, 4]) * MM_PER_PX
    np.testing.assert_allclose(found, mm / (most + SMALL_MM), rtol=1e-6)


def test_motion_is_measured_from_running_means() -> None:
    """Assert that a jump is seen whole but for what a running mean follows in a step, and a still field not at all."""
    found = numbers(uniform(1, 1, 2))
    for name in ("shears_20_ms", "shears_200_ms", "bends_20_ms"):
        assert found[name][:2] == pytest.approx([0, 0], abs=1e-6)
    assert found["shears_20_ms"][2] == pytest.approx(math.exp(-5 / 20) / 2, rel=1e-6)
    assert found["shears_200_ms"][2] == pytest.approx(math.exp(-5 / 200) / 2, rel=1e-6)
    for ms in (10, 30, 120):
        assert found[f"moves_{ms}_ms"][1] == pytest.approx(math.log(1e-3), rel=1e-6)
        assert found[f"moves_{ms}_ms"][2] == pytest.approx(math.log(math.exp(-5 / ms) / 2 + 1e-3), rel=1e-6)


def test_the_gripper() -> None:
    """Assert that position and current are compared with earlier ones, the goal with the position; unknown is 0."""
    told = [(100.0 + 3 * k, 110.0 + 3 * k, 20.0 - k, 0.5, 0.5) for k in range(25)]
    told[10] = (math.nan, math.nan, math.nan, 0.5, 0.5)
    found = numbers(uniform(*[1.0] * 25), told)
    assert found["gripper_known"] == [float(k != 10) for k in range(25)]
    assert found["closes_10_ms"] == [0.0, 0.0, *[6.0 * (k not in (10, 12)) for k in range(2, 25)]]
    assert found["closes_30_ms"] == [*[0.0] * 6, *[8.0 * (k not in (10, 16)) for k in range(6, 25)]]
    assert found["closes_100_ms"] == [*[0.0] * 20, *[8.0] * 5]
    assert found["goal_ahead"] == [float(k != 10) for k in range(25)]
    assert found["current_rises_20_ms"] == pytest.approx(
        [*[0.0] * 4, *[-0.4 * (k not in (10, 14)) for k in range(4, 25)]]
    )


def test_sensor_and_frame() -> None:
    """Assert that a stiffer gel and a less sensitive camera are taken into account, and a frame of fewer pixels."""
    sensor = Sensitivity(contrast_over_threshold=4.0, shear_modulus_pa=2 * SHEAR_MODULUS_PA)
    found, plain = numbers(uniform(2), sensor=sensor), numbers(uniform(2))
    assert found["stiffness"] == pytest.approx([math.log(2)])
    assert found["shear"] == pytest.approx([math.log(2 * 2 * MM_PER_PX / 0.1 + 0.05)], rel=1e-6)
    assert found["events"] == pytest.approx([math.log1p(4 * 56 * EVERY / 50)], rel=1e-6)
    small = numbers(uniform(1), frame_px=(320, 240))
    assert small == plain
    assert plain["stiffness"] == [0]


def test_no_contact_and_certainty() -> None:
    """Assert that odds without contact, and of shares 0 and 1, are their limits."""
    told = [NO_TOUCH, (*TOUCH[:3], 1.0, 1.0), (*TOUCH[:3], 0.0, math.nan)]
    found = numbers(uniform(1, 1, 1), told)
    assert found["slip_share_odds"] == pytest.approx([-5 / 3, -3, 3])
    assert found["slip_begun_odds"] == pytest.approx([-5 / 3, 3, -5 / 3])


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), cuts=st.lists(st.integers(0, 73), max_size=4))
def test_a_file_has_the_bits_of_its_slices(seed: int, cuts: list[int]) -> None:
    """Assert that numbers do not depend on how slices are cut into parts, and a copied state goes on alike."""
    rng, slices = np.random.default_rng(seed), 73
    moved = rng.normal(0, 3, (slices, 56, 2)).astype(np.float32)
    events = rng.integers(0, 9, (slices, 56)).astype(np.int32)
    told = np.where(rng.random((slices, 5)) < 0.3, np.nan, rng.random((slices, 5))).astype(np.float32)
    whole = load_path.over(load_path.start(SHAPE), moved, events, told)
    state, edges = load_path.start(SHAPE), [0, *sorted(cuts), slices]
    pieces = [slice(*pair) for pair in zip(edges, edges[1:], strict=False)]
    parts = load_path.joined([load_path.over(state, moved[one], events[one], told[one]) for one in pieces])
    live = load_path.start(SHAPE)
    rows: list[tuple[bytes, bool]] = []
    for k in range(slices):
        if load_path.step(live, moved[k], events[k], *told[k].tolist()):
            rows.append((live.numbers.tobytes(), live.touches))
            live = pickle.loads(pickle.dumps(live))
    for path in (parts, whole):
        assert path.slices == slices
        assert [(row.tobytes(), bool(touch)) for row, touch in zip(path.numbers, path.touches, strict=True)] == rows
    assert len(rows) == slices // EVERY
