"""Trials for the sticking share, its training and its judge: what is simulated, counted and kept apart."""

import numpy as np
import pytest

from evetac_cli.kernels.touch.sticking import INPUTS, StickingNetwork, slip_estimate
from scripts.reproduce.table_text import fill
from scripts.studies import motions
from scripts.studies.motions import Trial
from scripts.studies.sticking import judge, trials
from scripts.studies.sticking import train as training
from scripts.studies.sticking.trials import Looks

REST_PX = np.stack(np.meshgrid(np.linspace(50, 500, 8), np.linspace(40, 440, 7)), -1).reshape(-1, 2)


def trial(share: np.ndarray, slips: np.ndarray) -> Trial:
    """Dots that are pushed apart a little, with this truth."""
    pressed = REST_PX + 0.02 * (REST_PX - [320, 240])
    dots = np.repeat(pressed[None], len(share), axis=0).astype(np.float32)
    one = np.ones(len(share), np.float32)
    shear = np.stack([one, 0 * one], axis=1)
    return Trial(dots, REST_PX, 0.0329, share.astype(np.float32), slips, one, shear, 0 * one, (640, 480))


def looks(count: int, share: float, alarm: np.ndarray) -> Looks:
    """Looks every 5 ms that all say the same."""
    estimated = np.full(count, share, np.float32)
    fields = np.zeros((count, 2, len(REST_PX), 2), np.float32)
    inputs = np.zeros((count, INPUTS), np.float32)
    return Looks(4 + 5 * np.arange(count), inputs, estimated, estimated, estimated, 0 * estimated + 0.1, alarm, fields)


def test_errors_slips_and_alarms_are_counted() -> None:
    """Assert the counts of a trial with one slip, an alarm in time, one that lasts on, and a false one."""
    share, slips = np.zeros(2000), np.zeros(2000, np.bool_)
    share[1000:1200] = 0.5
    share[1150:1200] = 1.0
    slips[1150:1200] = True
    alarm = np.zeros(400, np.bool_)
    alarm[200:260] = True  # from 1004 to 1304: in time, and on for longer than 50 ms after
    alarm[340:345] = True  # false
    row = judge.judged(trial(share, slips), looks(400, 0.4, alarm))
    assert (row["slips"], row["possible"], row["network_in_time"], row["zero_in_time"]) == (1, 1, 1, 0)
    assert row["network_false"] == 2 and row["network_after"] == 2 and row["zero_false"] == row["network_early"] == 0
    assert row["network_late"] == 1
    assert row["looks_between"] == 30 and row["minutes"] == pytest.approx(2 / 60)
    assert row["network_error_sum"] == pytest.approx(3.0) and row["zero_error_sum"] == pytest.approx(15.0)
    assert row["within_sd"] == 30  # 0.1 off, and the deviation is 0.4
    shown = judge.summary("slip", [row, row])
    assert shown["network_error"] == pytest.approx(0.1) and shown["direction_off_deg"] == pytest.approx(5.73, abs=0.01)
    assert all(fill(cell, shown) for cell in judge.COLUMNS.values())
    early = np.zeros(400, np.bool_)
    early[170:] = True  # 150 ms before the share is above 0.05
    assert judge.judged(trial(share, slips), looks(400, 0.4, early))["network_early"] == 1
    late = np.zeros(400, np.bool_)
    late[227:] = True
    assert judge.judged(trial(share, slips), looks(400, 0.4, late))["network_in_time"] == 0


def test_what_is_judged_is_not_trained_on() -> None:
    """Assert that objects, motions and seeds of training, choosing and judging are apart, and all objects are used."""
    objects = (motions.TRAINED, motions.CHOSEN_BY, motions.JUDGED)
    assert sorted(number for some in objects for number in some) == list(range(1, 21))
    assert not set(training.COUNTS) & set(trials.UNSEEN) and not set(training.RESHAPED) & set(trials.UNSEEN)
    assert not set(motions.JERKS_MM_S) & set(motions.FAST_JERKS_MM_S)
    seeds = (training.FIRST_SEED, training.RESHAPED_SEED, training.CHOOSING_SEED)
    assert max(seeds) + 100 < 10_000


def test_a_training_learns_and_is_the_same_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a share which one input tells is learnt, alike with the same seed, and the kernel says so too."""
    monkeypatch.setattr(training, "EPOCHS", 5)
    rng = np.random.default_rng(2)
    inputs = np.zeros((4000, INPUTS), np.float32)
    inputs[:, -3:] = rng.normal(size=(4000, 3))
    share = (inputs[:, -1] > 0).astype(np.float32)
    learnt = training.Samples(inputs, share, np.where(rng.random(4000) < 0.2, np.nan, share).astype(np.float32))
    weights = training.trained(learnt, 3)
    estimated = training.estimate(weights, inputs)
    assert ((estimated > 0.5) == (share[:, None] > 0.5)).mean() > 0.9
    assert all(map(np.array_equal, weights, training.trained(learnt, 3)))
    network = StickingNetwork(*weights, np.ones(11, np.float32))
    assert slip_estimate(network, inputs[0]) == pytest.approx(estimated[0], abs=1e-4)
