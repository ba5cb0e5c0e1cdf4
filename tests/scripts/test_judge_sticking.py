"""Trials for the sticking share, its training and its judge: what is simulated, counted and kept apart."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.kernels.touch.sticking import FIELDS, INPUTS, LATTICE_MM, PATIENCE, StickingNetwork, slip_estimate

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import judge_sticking as judge
import motions
import results
import sticking_trials as trials
import train_sticking as training
from motions import Trial
from sticking_trials import Looks

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
    said = np.full(count, share, np.float32)
    fields = np.zeros((count, 2, len(REST_PX), 2), np.float32)
    inputs = np.zeros((count, INPUTS), np.float32)
    return Looks(4 + 5 * np.arange(count), inputs, said, said, said, 0 * said + 0.1, alarm, fields)


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
    assert all(results.fill(cell, shown) for cell in judge.COLUMNS.values())
    early = np.zeros(400, np.bool_)
    early[170:] = True  # 150 ms before the share is above 0.05
    assert judge.judged(trial(share, slips), looks(400, 0.4, early))["network_early"] == 1
    late = np.zeros(400, np.bool_)
    late[227:] = True
    assert judge.judged(trial(share, slips), looks(400, 0.4, late))["network_in_time"] == 0


def test_alarms_of_shares_have_the_same_patience() -> None:
    """Assert that PATIENCE looks in a row raise an alarm, and fewer do not."""
    share = np.zeros(20, np.float32)
    share[3 : 3 + PATIENCE] = share[12 : 12 + PATIENCE - 1] = 0.9
    assert np.flatnonzero(judge.alarms_of(share)).tolist() == [2 + PATIENCE]


def test_a_trial_without_camera_is_that_with_one() -> None:
    """Assert that dots and truth are the same numbers whether or not a camera looks, and that it saw something."""
    short = motions.planned("slip", 8, 9000)
    seen = 0

    class Enough(Exception):
        pass

    def rows(see: Any) -> list[dict[str, Any]]:
        timer = motions.untimed if see else motions.without_camera
        devices, slices = motions.slices_of(short, 0, 9000, timer)
        kept = [row for (_, row), _ in zip(slices, range(320), strict=False)]
        devices.close()
        return kept

    for with_camera, without in zip(rows(True), rows(False), strict=True):
        for name in ("truth/dot_xy_px", "truth/visible_slip_share", "truth/normal_force_n"):
            assert np.array_equal(with_camera[name], without[name])
        seen += 1
    assert seen == 320


@pytest.mark.parametrize("motion", motions.MOTIONS)
def test_a_motion_is_always_the_same(motion: str) -> None:
    """Assert that a seed plans the same trial again, and another seed another one where anything is drawn."""
    one, again, other = (motions.planned(motion, 7, seed) for seed in (5, 5, 6))
    assert one == again
    assert (one != other) == (motion in motions.CHANGES or motion == "opening")
    reshaped = motions.planned(motion, 7, 5, reshaped=True)
    assert reshaped.plan.touched != one.plan.touched


def test_what_is_judged_is_not_trained_on() -> None:
    """Assert that objects, motions and seeds of training, choosing and judging are apart, and all objects are used."""
    objects = (motions.TRAINED, motions.CHOSEN_BY, motions.JUDGED)
    assert sorted(number for some in objects for number in some) == list(range(1, 21))
    assert not set(training.COUNTS) & set(trials.UNSEEN) and not set(training.RESHAPED) & set(trials.UNSEEN)
    assert not set(motions.JERKS_MM_S) & set(motions.FAST_JERKS_MM_S)
    seeds = (training.FIRST_SEED, training.RESHAPED_SEED, training.CHOOSING_SEED)
    assert max(seeds) + 100 < 10_000


def test_the_error_of_a_tracker_is_as_told() -> None:
    """Assert the deviation that all dots share and that of each, within what 60 s of drift tell, from rest on."""
    still = trial(np.zeros(60_000), np.zeros(60_000, np.bool_))
    error = trials.tracked_px(still, np.random.default_rng(1)) - still.dot_px
    common = error.mean(axis=1)
    assert np.abs(error[0]).max() < 5 * trials.SLICE_PX
    assert common[3000:].std() == pytest.approx(trials.COMMON_PX, rel=0.3)
    own = (error - common[:, None])[3000:].std()
    assert own == pytest.approx(math.hypot(trials.OWN_PX, trials.SLICE_PX), rel=0.1)
    step = np.abs(np.diff(common, axis=0)).max()
    assert step < 0.05  # it drifts


def test_mirrored_inputs_are_those_of_the_mirrored_field() -> None:
    """Assert by a field whose value is its own place that mirroring moves places and turns one component."""
    fields = np.repeat(LATTICE_MM[:, None], FIELDS, axis=1).reshape(1, -1)
    inputs = np.concatenate([fields, [[0.7]]], axis=1).astype(np.float32)
    for axis in range(2):
        assert training.mirrored(inputs, axis) == pytest.approx(inputs, abs=1e-6)
    once = np.random.default_rng(0).normal(size=(3, INPUTS)).astype(np.float32)
    assert not np.array_equal(training.mirrored(once, 0), once)
    assert np.array_equal(training.mirrored(training.mirrored(once, 0), 0), once)


def test_a_training_learns_and_is_the_same_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a share which one input tells is learnt, alike with the same seed, and the kernel says so too."""
    monkeypatch.setattr(training, "EPOCHS", 5)
    rng = np.random.default_rng(2)
    inputs = np.zeros((4000, INPUTS), np.float32)
    inputs[:, -3:] = rng.normal(size=(4000, 3))
    share = (inputs[:, -1] > 0).astype(np.float32)
    learnt = training.Samples(inputs, share, np.where(rng.random(4000) < 0.2, np.nan, share).astype(np.float32))
    weights = training.trained(learnt, 3)
    said = training.told(weights, inputs)
    assert ((said > 0.5) == (share[:, None] > 0.5)).mean() > 0.9
    assert all(map(np.array_equal, weights, training.trained(learnt, 3)))
    network = StickingNetwork(*weights, np.ones(11, np.float32))
    assert slip_estimate(network, inputs[0]) == pytest.approx(said[0], abs=1e-4)


def test_networks_as_one_tell_the_mean_of_their_odds() -> None:
    """Assert that the joint network's log odds are the mean of those of two random ones."""
    rng = np.random.default_rng(4)
    shapes = [array.shape for array in training.blank()[:-1]]
    networks = [tuple(0.1 * rng.normal(size=shape).astype(np.float32) for shape in shapes) for _ in range(2)]
    inputs = rng.normal(size=(5, INPUTS)).astype(np.float32)

    def odds(weights: tuple[np.ndarray, ...]) -> np.ndarray:
        share = training.told(weights, inputs)
        return np.log(share / (1 - share))

    mean = (odds(networks[0]) + odds(networks[1])) / 2
    assert odds(training.as_one(networks)) == pytest.approx(mean, abs=1e-3)


def test_deviations_are_rms_errors_about_an_estimate() -> None:
    """Assert the rms error where all estimates are alike, and 0.05 where there are none."""
    said = np.full(5000, 0.3, np.float32)
    sd = training.deviations(said, said + np.float32(0.2))
    assert sd[7] == pytest.approx(0.2, abs=0.01) and sd[0] == pytest.approx(0.05)


def test_rows_are_kept_and_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that rows are read back, that more minutes make only the missing ones, and too few seeds are refused."""
    made: list[tuple[int, int]] = []

    def row_of(_: str, number: int, seed: int) -> dict[str, float]:
        made.append((number, seed))
        return {"minutes": 0.5}

    monkeypatch.setattr(judge, "row_of", row_of)
    assert len(judge.rows_of("fast jerks", range(9000, 9003), 2.0, tmp_path)) == 4
    assert len(judge.rows_of("fast jerks", range(9000, 9003), 3.0, tmp_path)) == 6 == len(made)
    assert len(made) == len(set(made))
    lines = (tmp_path / "fast-jerks.jsonl").read_text().splitlines()
    assert [json.loads(line)["object"] for line in lines] == list(motions.JUDGED)
    with pytest.raises(SystemExit, match="seeds are too few"):
        judge.rows_of("fast jerks", range(9000, 9003), 20.0, tmp_path)
