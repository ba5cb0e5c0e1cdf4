"""How far dots move under a weight, and how many events that makes, against the closed form of docs/simulator.md."""

from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.evaluate.stability.cases import merge
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2, material, pad
from evetac_cli.sim.setup.plan import Plan, first_plan
from tests.make import play_trial
from tests.sim.scenes.trials import grasp_of

REST_MS, LOADED_MS = 190, 900  # nothing hangs on the gel yet; the weight was handed over by 500


def hanging(number: str, mass_g: float, modulus_pa: float) -> Plan:
    """An object in the middle of a closed gel, gripped so firmly that nothing slips, before a camera without noise."""
    held = {"start_factor": [8.0, 8.0]}
    planned = first_plan("slip", number, gel="closed")
    planned = merge(planned, {"gripper": held, "randomise": {"touch_mm": None}, "object": {"mass_g": mass_g}})
    gel = {"shear_modulus_pa": modulus_pa, "dot_jitter_px": 0.0}
    return replace(planned, sensor=replace(planned.sensor, noise_hz=0.0, hot_pixels=0, **gel))


def path_px(mass_kg: float, planned: Plan) -> float:
    """(m g / 2) / (G/H p^2), in px: how far all dots together move under half a weight."""
    sensor, layer = planned.sensor, material(planned.sensor)
    pitches_px = (np.diff(line).mean() for line in (sensor.dot_columns_px, sensor.dot_rows_px))
    area_m2 = float(np.prod([pitch_px * sensor.mm_per_px * 1e-3 for pitch_px in pitches_px]))
    stiffness_n_m = layer.shear_modulus_pa / layer.height_m * area_m2
    return mass_kg * GRAVITY_M_S2 / 2 / stiffness_n_m * 1e3 / sensor.mm_per_px


def seen_share(planned: Plan) -> float:
    """The share of the gel's length along gravity that lies under dots: an upright cylinder presses on all of it."""
    sensor = planned.sensor
    nodes = pad(planned.scene.solver, sensor, cut=False)
    columns_mm = len(sensor.dot_columns_px) * np.diff(sensor.dot_columns_px).mean() * sensor.mm_per_px
    lines_m = nodes[0, :, 0]
    return float(columns_mm * 1e-3 / (np.diff(lines_m).mean() * len(lines_m)))


@pytest.mark.parametrize("modulus_pa", [72e3, 145e3])
@pytest.mark.parametrize(("number", "within"), [("3", 0.05), ("18", 0.05), ("19", 0.15)])
def test_the_path_of_all_dots_is_fixed_by_weight_and_stiffness(number: str, within: float, modulus_pa: float) -> None:
    """Assert that dots move by (m g / 2) / (G/H p^2) in all, as far as they are seen, whatever presses on them.

    And that they make no more events than their rims can: these are 2 r wide on either side, and a pixel that one
    passes makes contrast/threshold events.
    """
    planned = hanging(number, 150.0, modulus_pa)
    trial = grasp_of(planned)
    rows, events = play_trial(trial, LOADED_MS)
    assert not any(row["truth/slip"] for row in rows)
    places = np.array([row["truth/dot_xy_px"] for row in rows[REST_MS:]], float)
    # a ball touches dots alone, though the layer carries a tenth of its motion beyond them
    under_dots = 1.0 if number == "19" else seen_share(planned)
    expected_px = under_dots * path_px(trial.sampled.mass_kg, planned)
    assert (places[-1] - places[0])[:, 0].sum() == pytest.approx(expected_px, rel=within)
    path = float(np.linalg.norm(np.diff(places, axis=0), axis=2).sum())
    sensor = planned.sensor
    most = 4 * sensor.dot_radius_px * sensor.log_contrast / sensor.threshold
    assert 0.5 * most < sum(one.size for one in events[REST_MS:]) / path < most
