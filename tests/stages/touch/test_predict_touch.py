"""predict-touch: offline as online, known and unknown gels, maps, what a file says, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.errors import InputError
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.touch import sticking, touch_map
from evetac_cli.kernels.touch.dot_motion import DotNoise, GelLayer
from evetac_cli.sim.setup.plan import sensor_ranges
from evetac_cli.sim.setup.sampling import sample_sensor
from evetac_cli.stages.touch import known_gel, predict_touch, touch_fold
from evetac_cli.stages.touch.known_gel import KnownGel
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import run_valid
from tests.stages.touch.contacts import (
    MM_PER_PX,
    MODULUS_PA,
    SHEARED,
    SLICES,
    TOUCHED,
    contact,
    own_sensor,
    rest_mm,
    write_contact,
)


@pytest.fixture(scope="module")
def pressed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tracks of a ball that is pressed on and moved, and a sensor's file beside them."""
    folder = tmp_path_factory.mktemp("touch")
    own_sensor(folder)
    return write_contact(folder, 0, contact())


def known(path: Path) -> PredictTouch:
    return PredictTouch(sensor=str(path.with_name("1.0-1.sensor.toml")), stiffness_error=0.0)


def predicted(path: Path, chosen: PredictTouch, out: Path) -> dict[str, Any]:
    output, _ = run_valid(predict_touch, [path], chosen, out)
    with StageFile(output) as file:
        return {name: file.read(name) for name in file.contents()}


def test_offline_is_online(pressed: Path, tmp_path: Path) -> None:
    """Assert that a file holds what a touch map tells that is stepped slice by slice, and held where its dots rest."""
    told = predicted(pressed, replace(known(pressed), map_every=31), tmp_path)
    layer, noise = GelLayer(shear_modulus_pa=MODULUS_PA), DotNoise(0.05 * MM_PER_PX, 0.2 * MM_PER_PX)
    state = touch_map.start(rest_mm(), layer, noise)
    with StageFile(pressed) as tracks:
        dot_mm = (tracks.read("dot_xy_px") - [320, 240]) * MM_PER_PX
    sticks, reference = touch_fold.sticking_of(state), -1
    assert sticks is not None
    names = [name for name in touch_fold.OF_READING if name not in touch_fold.SINCE]
    nothing = np.zeros(len(dot_mm[0]), np.bool_)
    for number, where in enumerate(dot_mm):
        reading = touch_map.step(state, where)
        of_sticks = sticking.step(sticks, where, nothing, reading.touches)
        for name in [*names, *(touch_fold.SINCE if of_sticks.reference_slice >= 0 else ())]:
            np.testing.assert_allclose(told[name][number], getattr(reading, name), rtol=1e-5, atol=1e-6, err_msg=name)
        if of_sticks.reference_slice not in (-1, reference):
            touch_map.hold(state)
        reference = of_sticks.reference_slice
        assert told["reference_slice"][number] == reference
        for name in touch_fold.STICKING:
            np.testing.assert_allclose(told[name][number], getattr(of_sticks, name), rtol=1e-5, err_msg=name)
        if number % 31 == 0:
            for name in touch_fold.OF_MAP:
                at = told[f"map/{name}"][number // 31]
                np.testing.assert_allclose(at, getattr(reading, name), rtol=1e-5, atol=1e-3, err_msg=name)
    assert told["map/slice"].tolist() == list(range(0, SLICES, 31))
    assert told["reference_slice"][0] == -1 and TOUCHED + 190 < told["reference_slice"][SHEARED - 1] < SHEARED
    assert np.isnan(told["shear_since_n"][:TOUCHED]).all()
    assert (told["sticking_share"][TOUCHED + 10 :] >= 0).all()
    true = contact().net_since_pressed_n
    assert told["shear_since_n"][-1] == pytest.approx(true, abs=0.05 * np.hypot(*true))
    assert np.abs(told["shear_since_n"][SHEARED - 5]).max() < 0.02


def test_the_cut_of_blocks_changes_nothing(pressed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a gel that creeps is told the same whether its slices come at once or in blocks."""
    whole = predicted(pressed, replace(PredictTouch(), map_every=7), tmp_path / "whole.touch.h5")
    monkeypatch.setattr("evetac_cli.stages.BLOCK_ROWS", 61)
    blocks = predicted(pressed, replace(PredictTouch(), map_every=7), tmp_path / "blocks.touch.h5")
    assert whole.keys() == blocks.keys()
    for name, values in whole.items():
        np.testing.assert_allclose(blocks[name], values, rtol=1e-5, err_msg=name)
    assert np.abs(whole["shear_n"][SHEARED:]).max() > 0.1


def test_an_unknown_gel_is_told_with_wide_bounds(pressed: Path, tmp_path: Path) -> None:
    """Assert that forces of an unknown gel are off by a factor, as unsure as gels differ, and place and area stay."""
    sure = predicted(pressed, known(pressed), tmp_path / "known.touch.h5")
    unsure = predicted(pressed, PredictTouch(map_every=0), tmp_path / "unknown.touch.h5")
    assert not any(name.startswith("map/") for name in unsure)
    at = slice(SHEARED + 30, None)
    ratio = np.linalg.norm(unsure["shear_n"][at], axis=1) / np.linalg.norm(sure["shear_n"][at], axis=1)
    assert 0.6 < np.median(ratio) < 1.0
    assert (np.abs(unsure["shear_n"] - contact().net_shear_n)[at] < 2 * unsure["shear_sd_n"][at] + 0.02).all()
    assert (unsure["normal_sd_n"][at] > 3 * sure["normal_sd_n"][at]).all()
    assert np.abs(unsure["centre_mm"] - sure["centre_mm"])[at].max() < 0.3
    assert np.median(unsure["area_mm2"][at] / sure["area_mm2"][at]) == pytest.approx(1.0, abs=0.2)


def test_force_over_modulus_does_not_depend_on_the_modulus(pressed: Path) -> None:
    """Assert that twice the modulus is twice the force within 1 %, so that one fold does for all of them."""
    told = []
    with StageFile(pressed) as tracks:
        for modulus_pa in (MODULUS_PA, 2 * MODULUS_PA):
            gel = known_gel.gel_of(KnownGel(modulus_pa, MM_PER_PX), 0.1)
            told.append(touch_fold.slices_of(gel, tracks))
    at = slice(TOUCHED, None)
    size = np.linalg.norm(told[0].shear_mm2[at], axis=1)
    assert (np.linalg.norm(told[1].shear_mm2[at] - told[0].shear_mm2[at], axis=1) < 0.01 * size.max()).all()
    assert told[1].normal_mm2[at] == pytest.approx(told[0].normal_mm2[at], rel=0.02)


def test_what_is_expected_of_an_unknown_gel() -> None:
    """Assert that the table of what is expected is that of sensors drawn from `randomized`."""
    ranges = sensor_ranges()
    sensors = [sample_sensor(ranges, rng) for rng in np.random.default_rng(0).spawn(400)]
    moduli, scales = (np.log([getattr(one, key) for one in sensors]) for key in ("shear_modulus_pa", "mm_per_px"))
    assert np.exp(np.median(moduli)) == pytest.approx(known_gel.SHEAR_MODULUS_PA, rel=0.08)
    assert moduli.std() == pytest.approx(known_gel.SHEAR_LOG_SD, rel=0.08)
    assert np.exp(np.median(scales)) == pytest.approx(known_gel.MM_PER_PX, rel=0.01)
    assert scales.std() == pytest.approx(known_gel.MM_LOG_SD, rel=0.08)
    creeps = [one.creep for one in sensors if one.creep is not None]
    share, time_s = (np.array([getattr(one, key) for one in creeps]) for key in ("share", "time_s"))
    assert share.mean(axis=0) == pytest.approx(known_gel.CREEP_SHARE, rel=0.1)
    assert share.std(axis=0) == pytest.approx(known_gel.CREEP_SD, rel=0.1)
    assert np.exp(np.log(time_s).mean(axis=0)) == pytest.approx(known_gel.CREEP_TIME_S, rel=0.1)
    assert len(known_gel.CREEP_SHARE) == gel_forces.CREEP_ARMS


def test_lost_dots_and_no_touch(pressed: Path, tmp_path: Path) -> None:
    """Assert that where all dots are lost nothing is known, and that a gel at rest has no touch, no force, no area."""
    with StageFile(pressed) as file:
        header, arrays = file.header, {name: np.array(file.read(name)) for name in file.contents() if name != "x"}
        arrays["sensor/name"] = file.read("sensor/name")
    arrays["lost"][100:110] = 1
    path = tmp_path / "lost.tracks.h5"
    write_stage(path, Recipe("tracks", 1, {"preset": "lost"}, parents=(header,)), arrays)
    told = predicted(path, PredictTouch(map_every=5), tmp_path)
    assert not told["known"][100:110].any() and told["known"][110:].all()
    assert np.isnan(told["shear_n"][100:110]).all() and np.isnan(told["map/pressure_pa"][20:22]).all()
    rested = predicted(write_contact(tmp_path, 1, None), PredictTouch(map_every=0), tmp_path)
    assert not rested["touches"].any() and (rested["normal_n"] == 0).all() and (rested["area_mm2"] == 0).all()
    assert np.isnan(rested["shear_sd_n"]).all() and (rested["reference_slice"] == -1).all()
    _, outcome = run_valid(predict_touch, [tmp_path / "trial1.tracks.h5"], PredictTouch(), tmp_path / "r.touch.h5")
    assert outcome.rows[0]["max_shear_n"] is None and outcome.rows[0]["touched_s"] == 0.0


def test_the_scale_of_another_frame_has_to_be_known(tmp_path: Path) -> None:
    """Assert that a smaller frame is refused until its scale is known, and then tells what a whole one tells."""
    path = write_contact(tmp_path, 0, contact(), smaller=2)
    (tmp_path / "gel.sensor.toml").write_text('like = "evetac"\nshear_modulus_pa = 1e5\n')
    for sensor in (None, str(tmp_path / "gel.sensor.toml")):
        with pytest.raises(InputError, match=r"the scale of this frame(.|\n)*mm_per_px"):
            run_valid(predict_touch, [path], PredictTouch(sensor=sensor), tmp_path / "refused.h5")
    assert not (tmp_path / "refused.h5").exists()
    told = predicted(path, PredictTouch(sensor=own_sensor(tmp_path, smaller=2), map_every=0), tmp_path)
    assert told["shear_n"][-1] == pytest.approx(contact().net_shear_n, abs=0.1)


def test_what_cannot_be_told(pressed: Path, tmp_path: Path) -> None:
    """Assert that a print below the gel, three dots, and many sensors at once are refused in words."""
    for chosen, message in (
        (PredictTouch(print_depth_mm=4.0), "print_depth_mm: expected 0 to below 4 mm"),
        (PredictTouch(print_depth_mm=1.0, height_mm=0.5), "print_depth_mm: expected 0 to below 0.5 mm"),
        (PredictTouch(sensor="randomized"), "randomized:NUMBER"),
    ):
        with pytest.raises(InputError, match=message):
            run_valid(predict_touch, [pressed], chosen, tmp_path / "refused.h5")
    with StageFile(pressed) as file:
        header, arrays = file.header, {name: file.read(name) for name in file.contents()}
    arrays["sensor/dot_xy_px"] = arrays["sensor/dot_xy_px"][:1, :3]
    for name in ("dot_xy_px", "events_per_dot", "lost"):
        arrays[name] = arrays[name][:, :3]
    path = tmp_path / "few.tracks.h5"
    write_stage(path, Recipe("tracks", 1, {"preset": "few"}, parents=(header,)), arrays)
    with pytest.raises(InputError, match="no touch can be estimated from these dots"):
        run_valid(predict_touch, [path], PredictTouch(), tmp_path / "refused.h5")
    assert not list(tmp_path.glob("refused*"))
