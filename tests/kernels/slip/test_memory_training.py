"""Training with memory: which steps count and what they ask, and that a question which needs memory is learned."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels.slip import memory_training, networks, onnx_graphs, training
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, LOAD_PATH, OF_GRIPPER, MemoryArchitecture
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.load_path import EVERY, LoadPath
from evetac_cli.kernels.slip.memory_training import MemorySamples

MEMORY = ARCHITECTURES["load-path"]
assert isinstance(MEMORY, MemoryArchitecture)


def trajectory(
    numbers: NDArray[np.float32], label: NDArray[np.int8], touches: NDArray[np.bool_], share: object = None
) -> Trajectory:
    onset = int(np.argmax(label == 1)) if (label == 1).any() else -1
    path = LoadPath(numbers, touches, len(label))
    return Trajectory(path, np.zeros(len(label), np.int32), label, onset, share)  # type: ignore[arg-type]


def test_contacts_by_hand() -> None:
    """Assert that contacts are runs of touch to the last step that counts, and each step asks for the horizon."""
    label = np.zeros(200, np.int8)
    label[100:], label[:10] = 1, -1
    touches = np.ones(40, np.bool_)
    touches[[4, 5]] = False
    numbers = np.arange(40 * len(LOAD_PATH), dtype=np.float32).reshape(40, -1)
    samples = memory_training.gather([trajectory(numbers, label, touches)], MEMORY, 10)
    first, second = samples.contacts
    np.testing.assert_array_equal(first.numbers, numbers[:4])
    assert first.counts.tolist() == [0, 0, 1, 1]
    # steps end at slices 34, 39, ...; slip is within 10 ms from slice 90 on, and counts until 60 ms after it began
    np.testing.assert_array_equal(second.numbers, numbers[6 : 6 + 26])
    assert second.slips.tolist() == [float(5 * k + 4 >= 90) for k in range(6, 32)]
    assert second.counts.all() and np.isnan(second.share).all()
    assert samples.steps_per_epoch == 1


def test_the_true_share_is_asked_if_known() -> None:
    """Assert that a share of 0.3 that slips is the question instead of the label, and is passed on."""
    label, share = np.zeros(60, np.int8), np.zeros(60, np.float32)
    label[58:], share[31:41] = 1, 0.3
    zeros, touches = np.zeros((12, len(LOAD_PATH)), np.float32), np.ones(12, np.bool_)
    (one,) = memory_training.gather([trajectory(zeros, label, touches, share)], MEMORY, 5).contacts
    assert one.slips.tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0]
    np.testing.assert_array_equal(one.share, share[EVERY - 1 :: EVERY])


def made_up(trials: int, seed: int) -> list[Trajectory]:
    """Trials that slip at the end if a number was high at their start, which no later step shows."""
    rng, steps = np.random.default_rng(seed), 16
    result = []
    for k in range(trials):
        numbers = rng.normal(0, 0.3, (steps, len(LOAD_PATH))).astype(np.float32)
        numbers[:3, 2] = 4 * (k % 2)
        numbers[12:, 4] = 3
        numbers[:, OF_GRIPPER.start] = 1
        numbers[:, LOAD_PATH.index("stiffness")] = 0.3
        label = np.zeros(steps * EVERY, np.int8)
        label[60:] = k % 2
        result.append(trajectory(numbers, label, np.ones(steps, np.bool_), label.astype(np.float32)))
    return result


@pytest.fixture(scope="module")
def trained() -> training.SlipTraining:
    samples = memory_training.gather(made_up(60, 0), MEMORY, 0)
    preset = training.with_true_slip_share(training.MEMORY)
    return memory_training.train(samples, preset, np.random.default_rng(0), 500, 400)


def test_what_needs_memory_is_learned(trained: training.SlipTraining) -> None:
    """Assert that the network tells slip by what it saw ten steps before, with or without gripper."""
    weights = trained.checkpoints[-1].weights
    detector = Detector(onnx_graphs.build(MEMORY, weights), MEMORY)
    for one in made_up(20, 1):
        assert isinstance(one.series, LoadPath)
        for numbers in (one.series.numbers, one.series.numbers * (np.arange(len(LOAD_PATH)) < OF_GRIPPER.start)):
            found = detector.probability(numbers.astype(np.float32))
            assert found[:12].max() < 0.5
            assert (found[13:].min() > 0.5) if one.onset >= 0 else (found[13:].max() < 0.5)
    assert trained.curve_loss[-1] < 0.3 * trained.curve_loss[0]
    assert trained.cut and trained.steps == 400
    assert [one.step for one in trained.checkpoints] == list(range(40, 401, 40))


def test_what_never_varied_is_not_seen(trained: training.SlipTraining) -> None:
    """Assert that a number without variation has the scale 0, and the gripper, unknown in some contacts, has not."""
    scale = trained.checkpoints[-1].weights["input_scale"]
    assert np.flatnonzero(scale == 0).tolist() == [LOAD_PATH.index("stiffness")]


def test_the_end_is_read_back(trained: training.SlipTraining) -> None:
    """Assert that the state at the end gives the same result again, and that the same seed gives the same weights."""
    again = training.ended(trained.preset, trained.state)
    assert again is not None and again.steps == trained.steps
    for one, other in zip(trained.checkpoints, again.checkpoints, strict=True):
        assert one.weights.keys() == other.weights.keys()
        assert all(np.array_equal(one.weights[name], other.weights[name]) for name in one.weights)
    samples = memory_training.gather(made_up(5, 0), MEMORY, 0)
    runs = [memory_training.train(samples, training.MEMORY, np.random.default_rng(3), 1, 3) for _ in range(2)]
    first, second = (run.checkpoints[-1].weights for run in runs)
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert runs[0].steps == 1  # a pass over so few


def test_a_trained_network_is_adapted(trained: training.SlipTraining) -> None:
    """Assert that small steps from given weights stay near, with the same normalisation."""
    start = trained.checkpoints[-1].weights
    samples = memory_training.gather(made_up(10, 2), MEMORY, 0)
    run = memory_training.train(samples, training.ADAPT_MEMORY, np.random.default_rng(0), 10, start=start)
    for name, array in run.checkpoints[-1].weights.items():
        moved = np.abs(array - start[name]).max()
        assert moved == 0 if name.startswith("input_") else 0 < moved < 0.005


def test_refusals() -> None:
    """Assert that contacts of one answer alone are refused, and a loss that is not finite."""
    for kept in (0, 1):
        with pytest.raises(ValueError, match="at least one labelled step"):
            memory_training.gather(made_up(4, 0)[kept:1:2] if kept else made_up(4, 0)[::2], MEMORY, 0)
    samples = memory_training.gather(made_up(4, 0), MEMORY, 0)
    broken = [one._replace(numbers=one.numbers * np.float32(np.nan)) for one in samples.contacts]
    start = networks.weights(networks.build(MEMORY))
    with pytest.raises(ValueError, match="finite loss"):
        memory_training.train(
            MemorySamples(MEMORY, broken), replace(training.MEMORY), np.random.default_rng(0), 1, start=start
        )
