"""evetac/Lift-v0: Gymnasium's own checker, the loop of `grasp` within it, rewards and refusals."""

import importlib
import sys
import tomllib
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils import env_checker

import evetac_cli
from evetac_cli import gym
from evetac_cli.devices.simulated import rig
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.kernels.grip.control import Control, FixedGrip
from evetac_cli.resources import SCENES
from evetac_cli.text_files import as_toml
from evetac_cli.trials.grasp.loop import Timing, grasp_slices

SHORT = {"hand_mm_s": 400.0, "lift_s": 0.6, "balance_s": 0.1}


@pytest.fixture(scope="module")
def quick_touch(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The lift scene on a coarse gel, with a short contact phase."""
    changed = tomllib.loads((SCENES / "lift.toml").read_text())
    changed["time"] |= {"touch_s": 0.6, "before_rise_s": 0.1}
    changed["solver"] = {"node_pitch_mm": 2.5}
    path = tmp_path_factory.mktemp("lift") / "quick.toml"
    path.write_text(as_toml(changed))
    return str(path)


def make_lift(quick_touch: str, **more: Any) -> Any:
    return gymnasium.make("evetac/Lift-v0", scene=quick_touch, **{"objects": "8,4", **SHORT, **more})


def episode(env: Any, share: float, seed: int, **options: Any) -> tuple[list[float], dict[str, Any], bool, bool]:
    """An episode with one goal: rewards, the last info, and how it ended."""
    env.reset(seed=seed, options=options)
    rewards, terminated, truncated, info = [], False, False, {}
    while not (terminated or truncated):
        observation, reward, terminated, truncated, info = env.step(np.array([share], np.float32))
        assert observation in env.observation_space
        rewards.append(reward)
    return rewards, info, terminated, truncated


@pytest.mark.slow
def test_the_checker_passes(quick_touch: str) -> None:
    """Assert that Gymnasium's checker is content; its warnings are errors here."""
    env_checker.check_env(make_lift(quick_touch).unwrapped)


def test_an_episode_is_a_grasp(quick_touch: str) -> None:
    """Assert that a goal of 20 ticks that stays is the controller fixed:20: the same events and forces."""
    env = make_lift(quick_touch, objects="8").unwrapped
    env.reset(seed=5)
    drawn, _ = gymnasium.utils.seeding.np_random(5)
    drawn.choice([8])
    seeds = [int(part) for part in drawn.integers(2**31, size=4)]
    devices = rig(env._plans[8].of_trial(seeds), np.random.SeedSequence(seeds), lift_s=0.6, balance_s=0.1)
    slices = grasp_slices(devices, None, Control(FixedGrip(20), 50.0), Timing(600, 600, 100, 50.0))
    for _ in range(600):
        next(slices)
    for _ in range(10):
        _, _, _, _, info = env.step(np.array([20 / gym.MOST_TICKS], np.float32))
        events = [next(slices) for _ in range(20)]
        assert sum(part.size for part, _ in events) == env._events.size
        assert info["normal_force_n"] == events[-1][1]["truth/normal_force_n"]


def test_reward_and_end(quick_touch: str) -> None:
    """Assert what an episode comes to: lifted and held, 2 less the costs; a hand that does not close, no reward."""
    env = make_lift(quick_touch)
    rewards, info, terminated, truncated = episode(env, 0.5, 3, object=8)
    assert (info["lifted"], info["balanced"], terminated, truncated) == (True, True, False, True)
    assert info["simulated"] and info["object"] == 8
    assert len(rewards) == 35
    assert 1.0 < sum(rewards) < 2.0
    left, info, terminated, truncated = episode(env, 0.0, 3, object=4)
    assert (info["lifted"], terminated, truncated, info["object"]) == (False, True, False, 4)
    assert sum(left) <= 0.0
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.unwrapped.step(np.zeros(1, np.float32))


def test_what_is_drawn(quick_touch: str) -> None:
    """Assert that a seed gives the same object, mass and first observation, and that seeds differ."""
    env = make_lift(quick_touch, render_mode="rgb_array")
    (one, drawn), (same, again), (_, other) = (env.reset(seed=seed) for seed in (7, 7, 8))
    assert drawn == again != other
    assert all(np.array_equal(one[name], same[name]) for name in one)
    picture = env.render()
    assert picture.shape == (480, 640, 3)
    assert set(np.unique(picture)) <= {0, 128, 255}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"objects": "99"}, "no such object"),
        ({"mass_factor": (2.0, 1.0)}, "mass_factor"),
        ({"hand_mm_s": 0.0}, "hand_mm_s: out of range"),
        ({"hand_mm_s": 2e3}, "hand_mm_s: out of range"),
        ({"lift_s": 0.2}, "lift_s: out of range\n  expected: .* s, the time that the hand takes to rise"),
        ({"control_hz": 30.0}, "divides 1000"),
        ({"sensor": "none"}, "no such sensor"),
    ],
)
def test_what_cannot_be_is_refused(quick_touch: str, given: dict[str, Any], said: str) -> None:
    """Assert that values that cannot be are refused in words."""
    with pytest.raises(InputError, match=said):
        gym.LiftEnv(**{"scene": quick_touch, **SHORT, **given})


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that without gymnasium the import says which extra brings it."""
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "evetac_cli.gym")
    monkeypatch.delattr(evetac_cli, "gym", raising=False)
    with pytest.raises(EvetacError, match=r"gymnasium is not installed(.|\n)*\[robot\]"):
        importlib.import_module("evetac_cli.gym")
