"""A speaker on the gel: its waves, the layer's answer, what the dots do, and what a recording of it holds."""

import math
import tomllib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.resources import SCENES
from evetac_cli.sim.gel.gel import GelMaterial
from evetac_cli.sim.scenes.vibrating import ORDERS, Drift, Vibration, pressed_by_disc, resonance, waves
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.text_files import as_toml
from evetac_cli.trials import record
from tests.quick import few

PURE = {"second_harmonic_least": [0.0] * 5, "second_harmonic_most": [0.0] * 5, "modulation_most": [0.0] * 5}
SHORT = {"rest_s": 0.01, "tone_at_s": 0.05, "after_s": 0.02}


def changed(tmp_path: Path, time: dict[str, Any], **tone: Any) -> str:
    table = tomllib.loads((SCENES / "vibration.toml").read_text())
    table["time"] |= SHORT | time
    table["tone"] |= {"press_s": 0.03} | tone
    path = tmp_path / "changed.toml"
    path.write_text(as_toml(table))
    return str(path)


def vibration(scene_name: str, hz: float, *, seed: int = 0, sensor: str = "evetac", gel: str = "closed") -> Vibration:
    planned = first_plan(scene_name, sensor=sensor, gel=gel, tones=f"{hz:g}")
    return Vibration(planned, *map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2)))


@given(
    h2=st.floats(0, 1),
    m=st.floats(0, 1),
    phase=st.floats(0, 2 * math.pi),
    turn=st.floats(0, 4 * math.pi),
)
def test_waves_are_the_modulated_tone(h2: float, m: float, phase: float, turn: float) -> None:
    """Assert that the five waves sum to [sin + h2 sin(2 . + 90 deg)] (1 + m sin(. / 2 + phase))."""
    sum_of_waves = (waves(np.array(h2), np.array(m), phase) * np.exp(1j * ORDERS * turn)).sum().real
    tone = math.sin(turn) + h2 * math.sin(2 * turn + math.pi / 2)
    assert sum_of_waves == pytest.approx(tone * (1 + m * math.sin(turn / 2 + phase)), abs=1e-12)


@pytest.mark.parametrize("frequency_hz", [100.0, 498.0, 996.0])
def test_resonance_is_that_of_the_layer(frequency_hz: float) -> None:
    """Assert that gain and phase are those of the layer's equation of motion, integrated until it is stationary."""
    layer = GelMaterial()
    omega = 2 * np.pi * frequency_hz
    stiffness = layer.shear_modulus_pa / layer.height_m
    mass = 4 * layer.density_kg_m3 * layer.height_m / np.pi**2

    def motion(t: float, y: np.ndarray) -> list[float]:
        strain, rate = y[0] - np.sin(omega * t), y[1] - omega * np.cos(omega * t)
        force = stiffness * (strain + layer.viscous_time_s * rate) + y[2]
        return [y[1], -force / mass, layer.maxwell_share * stiffness * rate - y[2] / layer.maxwell_time_s]

    time_s = 0.15 + np.arange(64) / (16 * frequency_hz)
    result = solve_ivp(motion, (0.0, time_s[-1]), [0.0, 0.0, 0.0], "DOP853", time_s, rtol=1e-9, atol=1e-9).y[0]
    amplitude = 2 * (result * np.exp(-1j * omega * time_s)).mean() * 1j
    assert amplitude == pytest.approx(resonance(np.array([frequency_hz]), layer)[0], rel=1e-4)


def test_a_disc_moves_what_it_holds() -> None:
    """Assert that what a disc holds moves as it does and is not squeezed but seen larger, and that others move less.

    Three quarters of a height from the rim a third of the motion is left before and behind, less beside it;
    what is squeezed out moves away, by less than the indentation.
    """
    layer = GelMaterial()
    points = np.array([[0.0, 0.0], [1e-3, 2e-3], [-3e-3, 2.5e-3], [8e-3, 0.0], [0.0, -8e-3], [14e-3, 0.0]])
    shift, aside, answer_m = pressed_by_disc(points, np.zeros(2), 5e-3, layer, 1e6)
    alone_m = np.pi * 5e-3**2 / layer.height_m  # without the gel around it
    assert answer_m == pytest.approx(answer_m[0, 0] * np.eye(2), abs=3e-3 * answer_m[0, 0])
    assert 1.5 * alone_m < answer_m[0, 0] < 3 * alone_m
    assert aside[:3] == pytest.approx(np.broadcast_to(np.eye(2), (3, 2, 2)), abs=1e-9)
    assert shift[:3] == pytest.approx(points[:3] / 25e-3, rel=1e-6, abs=1e-12)
    assert 0.02 < aside[3, 1, 1] < aside[3, 0, 0] < 0.6
    assert aside[4, 1, 1] == pytest.approx(aside[3, 0, 0], rel=0.05)
    assert 0.1 < shift[3, 0] < 1.0 and shift[4, 1] == pytest.approx(-shift[3, 0], rel=0.05)
    assert abs(shift[5, 0]) < 0.3 * shift[3, 0] and abs(aside[5, 0, 0]) < 0.1


@given(seed=st.integers(0, 1000))
def test_drift_is_smooth_and_stays_in_range(seed: int) -> None:
    """Assert that a drift keeps to its range, reaches its values, lasts, and has no steps."""
    drift = Drift.sample(0.25, 0.45, (1.0, 3.0), 20.0, np.random.default_rng(seed))
    time_s = np.linspace(-1.0, 25.0, 26001)
    value = drift.at(time_s)
    assert value.min() >= 0.25 and value.max() <= 0.45
    assert drift.time_s[-1] >= 20.0
    assert drift.at(drift.time_s) == pytest.approx(drift.value)
    assert np.abs(np.diff(value)).max() < 0.2 * np.pi / 2 * 1e-3 * 1.01
    spans = np.diff(drift.time_s)
    assert spans.min() >= 1.0 and spans.max() <= 3.0


@pytest.mark.parametrize(("hz", "motion_px"), few([(100, 0.4), (333.3, 0.2), (2500, 0.1)], (333.3, 0.2)))
def test_dots_move_as_far_as_the_table_says(hz: float, motion_px: float, tmp_path: Path) -> None:
    """Assert that a pure tone is a sine at its frequency with the table's amplitude (rms over the dots), no jumps."""
    name = changed(tmp_path, {"tone_s": 10.0}, dot_motion_px=[motion_px] * 5, amplitude_factor=[1.0, 1.0], **PURE)
    trial = vibration(name, hz)
    trial._render = lambda *given: slices.append(given[4])
    slices: list[np.ndarray] = []
    while trial.slices < 240:
        trial.step()
    pieces = len(slices[0]) - 1
    assert pieces * 1000 >= 16 * hz
    assert all((one[-1] == other[0]).all() for one, other in zip(slices, slices[1:], strict=False))
    path_px = np.concatenate([piece[:-1] for piece in slices[200:]]) / trial.gel_camera.mm_per_px * 1e3
    since_s = 0.2 + np.arange(len(path_px)) / (1000 * pieces)
    basis = np.stack(
        [np.sin(2 * np.pi * hz * since_s), np.cos(2 * np.pi * hz * since_s), np.ones(len(since_s))], axis=1
    )
    flat = path_px.reshape(len(path_px), -1)
    result, *_ = np.linalg.lstsq(basis, flat)
    assert np.abs(flat - basis @ result).max() < 1e-9
    amplitude = np.sqrt((result[:2] ** 2).sum() / (flat.shape[1] / 2))
    assert amplitude == pytest.approx(motion_px, rel=1e-6)


def test_silence_tone_silence(tmp_path: Path) -> None:
    """Assert that the tone sounds when the scene says, dots are still before and after, and the press lasts."""
    trial = vibration(changed(tmp_path, {"tone_s": 0.1}), 200)
    rows, events = [], []
    while not trial.finished:
        events.append(trial.step().size)
        rows.append(trial.truth())
    dots = np.array([row["truth/dot_xy_px"] for row in rows])
    moved = np.abs(np.diff(dots, axis=0)).max(axis=(1, 2))
    assert len(rows) == 170
    sounds = np.array([row["truth/tone_hz"] for row in rows])
    assert (sounds[50:149] == 200).all() and not sounds[:50].any() and not sounds[149:].any()
    assert moved[:9].max() == 0 and moved[40:49].max() == 0 and moved[151:].max() == 0
    assert moved[70:130].max() > 0.05
    assert rows[45]["truth/normal_force_n"] == rows[-1]["truth/normal_force_n"] == 2.5
    assert np.mean(events[75:130]) > 20 * np.mean(events[151:])
    pulled = np.array([row["truth/shear_force_n"] for row in rows])
    assert not pulled[:50].any() and 0.01 < np.abs(pulled[70:130]).max() < 2.5


@pytest.mark.parametrize("hz", few([100, 200, 300, 400, 498], 100, 498))
def test_the_scene_is_felt_at_few_events(hz: int, tmp_path: Path) -> None:
    """Assert that the shipped scene's tones, at the middle of their ranges, lead at 1,500 events a slice or fewer."""
    tone = tomllib.loads((SCENES / "vibration.toml").read_text())["tone"]
    middle = [
        (low + high) / 2 for low, high in zip(tone["second_harmonic_least"], tone["second_harmonic_most"], strict=True)
    ]
    steady = {"second_harmonic_least": middle, "second_harmonic_most": middle, "amplitude_factor": [1.0, 1.0]}
    name = changed(tmp_path, {"tone_s": 0.4}, **steady)
    trial = vibration(name, hz)
    at = tone["at_hz"].index(hz)
    trial._modulation = Drift(np.array([0.0, 1.0]), np.full(2, tone["modulation_most"][at] / 2))
    counts = np.array([trial.step().size for _ in range(400)])[100:]
    assert 500 < counts.mean() < 1500
    amplitude = np.abs(np.fft.rfft(counts - counts.mean()))
    amplitude[: math.ceil(25 * 0.3)] = 0.0
    assert abs(np.argmax(amplitude) / 0.3 - hz) < 1 / 0.3  # frequencies are 3.3 Hz apart


def test_a_recording_a_tone(tmp_path: Path) -> None:
    """Assert that record makes a valid file of each tone, named after it, which holds the tone's truth."""
    params = Record(scene=changed(tmp_path, {"tone_s": 0.03}), tones="200,333.5")
    jobs = record.jobs([], params, tmp_path)
    names = ["vibration-200hz-s0-000.recording.h5", "vibration-333.5hz-s0-000.recording.h5"]
    assert [job.output.name for job in jobs] == names
    everything = Record(scene=params.scene)
    assert len(record.jobs([], everything, tmp_path)) == 5
    with pytest.raises(InputError, match="no tones"):
        record.jobs([], Record(scene="slip", tones="200"), tmp_path)
    for job in jobs:
        record.run(job, params)
    assert validate.run([job.output for job in jobs]).summary["invalid"] == 0
    with h5py.File(jobs[1].output) as file:
        assert file["truth/tone_hz"][65] == 333.5
        assert file["truth/tone_amplitude_um"][:].max() > 1
        assert 0.25 <= file["truth/tone_second_harmonic"][65] <= 0.45
        assert 0 <= file["truth/tone_modulation"][65] <= 0.5
        assert "gripper" not in file
