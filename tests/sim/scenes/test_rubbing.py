"""The edge scene: an object with edges that a hand rubs over the gel."""

import json
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.simulated import rig
from evetac_cli.evaluate.stability.cases import merge
from evetac_cli.sim.scenes.rubbing import Rubbing
from evetac_cli.sim.setup.parts import rows_of
from evetac_cli.sim.setup.plan import first_plan
from tests.make import play_trial


def rubbing(object_name: str, sensor: str = "evetac", gel: str = "cut", seed: int = 0, **rub: Any) -> Rubbing:
    """A trial of the scene with an object, and a coarse gel."""
    changes = {"rub": {"objects": [object_name], **rub}, "solver": {"node_pitch_mm": 1.25}}
    made = merge(first_plan("edge", sensor=sensor, gel=gel), changes)
    return Rubbing(made, *(np.random.default_rng([seed, part]) for part in range(2)))


def column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([row[f"truth/{name}"] for row in rows])


@pytest.mark.parametrize(
    ("object_name", "sensor", "gel"),
    [("finger", "evetac", "cut"), pytest.param("handle", "second", "closed", marks=pytest.mark.slow)],
)
def test_most_events_are_not_from_dots(object_name: str, sensor: str, gel: str) -> None:
    """Assert that lines make most events of a rub, that dots end where they began, and forces are as planned."""
    trial = rubbing(object_name, sensor, gel, count=[3, 3], length_mm=[18.0, 18.0], speed_mm_s=[100.0, 100.0])
    rows, events = play_trial(trial)
    sizes = np.array([part.size for part in events])
    lines = column(rows, "contact_edge_events")
    moved = np.linalg.norm(column(rows, "dot_xy_px") - trial.gel_camera.grid_xy_px.reshape(-1, 2), axis=2)
    rubs = slice(2090, len(sizes) - 1300)
    noise = np.median(sizes[50:450])
    assert (lines <= sizes).all()
    assert (lines[rubs].sum() + noise * len(lines[rubs])) / sizes[rubs].sum() > 0.7
    assert moved[-1].max() < 0.2
    assert moved[800:1800].max() > 3.0
    force = column(rows, "normal_force_n")
    assert 1.0 <= force[810] <= trial._normal_n  # the part beside the pad presses on nothing
    assert force[:490].max() == force[-990:].max() == 0.0
    assert lines[:490].max() == lines[-900:].max() == 0
    travel = np.linalg.norm(np.diff(column(rows, "object_xy_px"), axis=0), axis=1)
    assert travel[820:1780].sum() == pytest.approx(32.0, rel=0.02)
    assert travel[rubs].sum() * trial.gel_camera.mm_per_px == pytest.approx(3 * 18.0, rel=0.01)
    assert travel.max() * trial.gel_camera.mm_per_px == pytest.approx(0.1, rel=0.01)  # mm in a ms at the peak


def test_drawn_and_dry() -> None:
    """Assert that the truth says what was sampled, both objects come up, and the parts name the contact edges."""
    made = first_plan("edge")
    samples = [json.loads(str(rig(made, np.random.SeedSequence(seed)).sampled)) for seed in range(8)]
    assert {one["object_name"] for one in samples} == {"finger", "handle"}
    assert all(0.55 <= one["edge_log_contrast"] <= 0.8 and 1.5 <= one["edge_blur_px"] <= 3 for one in samples)
    built = {row["part"] for row in rows_of(made) if row["built"] is not None}
    assert {"contact edges", "cut edge"} <= built
    assert "gripper" not in built


def test_directions_keep_the_object_in_view() -> None:
    """Assert that the middle of the object stays within the frame, or nearly, whatever is drawn."""
    for seed in range(20):
        trial = rubbing("handle", seed=seed, count=[6, 6])
        place_px = trial._starts_px + trial.timeline.xy_m * 1e3 / trial.gel_camera.mm_per_px
        assert (np.abs(place_px) < [420.0, 330.0]).all()
