"""A sensor as a file: what is accepted, how what is wrong is said, and that only the content counts."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.setup import sensor_file
from evetac_cli.sim.setup.plan import named_sensor, one_sensor
from evetac_cli.sim.setup.sensor_rows import FOR_EACH_TRIAL, GRID, rows
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.text_files import as_toml
from evetac_cli.trials import record
from evetac_cli.trials.record import simulated

HOT = {
    "x_px": [3, 600],
    "y_px": [4, 470],
    "rate_hz": [50.0, 900.0],
    "on_share": [0.7, 0.5],
    "polarity_change_share": [0.2, 0.9],
    "dead_time_us": 400.0,
    "short_interval_share": [0.0, 0.4],
    "short_interval_us": [0.0, 300.0],
}

FEW = [[100.0, 100.0], [200.0, 100.0], [100.0, 200.0], [230.0, 230.0]]


def written(folder: Path, stem: str = "mine", /, **keys: Any) -> str:
    path = folder / f"{stem}.sensor.toml"
    path.write_text(as_toml({"like": "evetac", **keys}))
    return str(path)


@pytest.mark.parametrize("name", [*(name for name in rows() if name not in FOR_EACH_TRIAL), "randomized:3"])
def test_sensors_of_the_package_pass_the_schema(name: str, tmp_path: Path) -> None:
    """Assert that every named sensor is a whole row, and that the same row comes back from a file that holds it."""
    sensor = one_sensor(name)
    assert sensor_file.of_row(as_table(sensor), name) == sensor
    path = tmp_path / "same.toml"
    path.write_text(as_toml(as_table(sensor)))
    assert named_sensor(str(path)) == ("own-sensor", sensor)


def test_what_a_file_leaves_out_is_as_in_the_sensor_it_is_like(tmp_path: Path) -> None:
    """Assert that named keys replace those of the sensor, tables key by key, and that all others stay."""
    _, sensor = named_sensor(written(tmp_path, noise_hz=1, gripper={"mass_kg": 3}))
    assert as_table(sensor) == {**as_table(one_sensor("evetac")), "noise_hz": 1.0, "gripper": {"mass_kg": 3.0}}
    assert isinstance(sensor.noise_hz, float)
    _, other = named_sensor(written(tmp_path, like="randomized:2", gripper={"mass_kg": 3.0}))
    assert other.gripper == replace(one_sensor("randomized:2").gripper, mass_kg=3.0)


def test_places_of_all_dots(tmp_path: Path) -> None:
    """Assert that a sensor shows its dots exactly where its file has them, a cut gel those beside its window."""
    dots = dot_grid(one_sensor("randomized:4"), cut=False) + 0.25
    _, sensor = named_sensor(written(tmp_path, dot_xy_px=dots.tolist()))
    np.testing.assert_array_equal(dot_grid(sensor, cut=False), dots)
    np.testing.assert_array_equal(dot_grid(sensor, cut=True), dots[:, :8])
    assert not {"dot_columns_px", "dot_rows_px", "dot_jitter_px", "turned_deg"} & as_table(sensor).keys()


def test_dots_in_a_list_without_rows(tmp_path: Path) -> None:
    """Assert that a list of dots in any order is put into the rows of its grid, or is one row where it has none."""
    dots = dot_grid(one_sensor("evetac"), cut=False)
    shuffled = np.random.default_rng(0).permutation(dots.reshape(-1, 2))
    _, sensor = named_sensor(written(tmp_path, dot_xy_px=shuffled.tolist()))
    np.testing.assert_array_equal(dot_grid(sensor, cut=False), dots)
    _, sensor = named_sensor(written(tmp_path, dot_xy_px=shuffled[1:].tolist()))
    np.testing.assert_array_equal(dot_grid(sensor, cut=False), shuffled[None, 1:])
    beside = dot_grid(sensor, cut=True)
    assert beside.shape == (1, 56 - (shuffled[0, 0] < 525), 2)
    assert beside[..., 0].max() + sensor.dot_radius_px < sensor.window_px[0]


def test_columns_and_rows_instead_of_the_places_of_another_sensor(tmp_path: Path) -> None:
    """Assert that a whole row with places and one with columns and rows both pass, and one with neither does not."""
    sensor = one_sensor("evetac")
    places = {key: value for key, value in as_table(sensor).items() if key not in GRID}
    with pytest.raises(InputError, match="the positions of the dots are missing"):
        sensor_file.of_row(places, "here")
    sensor_file.of_row({**places, "dot_xy_px": dot_grid(sensor, cut=False).tolist()}, "here")


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"noise": 1.0}, "did you mean noise_hz"),
        ({"gripper": {"mass": 1.0}}, "gripper.mass"),
        ({"noise_hz": "much"}, "noise_hz: expected a number"),
        ({"noise_hz": True}, "noise_hz: expected a number"),
        ({"bandwidth_by_light": "yes"}, "bandwidth_by_light: expected true or false"),
        ({"distortion": [0.1]}, "distortion: wrong number of entries"),
        ({"readout": {"events_per_s": 10.0}}, "readout.events_per_s: out of range"),
        ({"noise_hz": float("nan")}, "noise_hz: not a finite number"),
        ({"hot_pixel_hz": [20.0, float("inf")]}, "hot_pixel_hz.1: not a finite number"),
        ({"noise_hz": -1.0}, "0 to 10000"),
        ({"hot_pixels": 1.5}, "hot_pixels: expected a whole number"),
        ({"hot_pixel_hz": [1.0] * 5000}, "2 to 1,000 entries"),
        ({"hot_pixel_hz": [9.0, 1.0]}, "hot_pixel_hz: expected rising values"),
        ({"noise_filter": {"support_ms": 0.0}}, "noise_filter.support_ms: out of range"),
        ({"window_px": [640, 0, 540, 480]}, "window_px: not a window"),
        ({"frame_px": [320, 240]}, "frame_px: invalid value"),
        ({"like": "evtac"}, "did you mean evetac"),
        ({"like": "randomized"}, "not one sensor but many"),
        ({"like": "randomized-narrow"}, "not one sensor but many"),
        ({"name": "second"}, "evetac already has a sensor"),
        ({"name": "A name"}, "name: invalid value"),
        ({"gripper": {"servo_n_tick": 2.0}}, "servo_n_tick and two_ticks_n must be set"),
        ({"gripper": {"servo_n_tick": 2.0, "two_ticks_n": 0.1, "friction_n": 3.0}}, "servo_n_tick and friction_n"),
        ({"like": "randomized:7", "gripper": {"gain_ma_tick": 5.0}}, "servo_n_tick and gain_ma_tick"),
        ({"friction": {"patch_spread": 0.1}}, "patch_spread and patch_mm must be set"),
        ({"creep": {"share": [0.1], "time_s": [1.0, 2.0]}}, "1 in share, 2 in time_s"),
        ({"dot_xy_px": [[[1.0, 2.0], [3.0, 4.0]], [[1.0, 9.0], [3.0, 9.0], [5.0, 9.0]]]}, "the same number of dots"),
        ({"dot_xy_px": [*FEW, [200.0, 100.0]]}, "two dots overlap"),
        ({"dot_xy_px": [*FEW, [217.0, 100.0]]}, "centres at least a diameter apart, 18 px"),
        ({"dot_xy_px": [*FEW, [300.0, 479.5]]}, "a dot is outside the frame"),
        ({"dot_xy_px": [*FEW, [650.0, 100.0]]}, "dot_xy_px.0.4.0: out of range"),
        ({"dot_xy_px": [*FEW, [600.0, 9.0]], "distortion": [0.3, 0.3]}, "a dot is outside the frame"),
        ({"dot_xy_px": FEW[:1]}, "4 to 256 dots"),
        ({"dot_xy_px": [[float(n % 640), float(n // 640)] for n in range(5000)]}, "found:    5,000 entries"),
        ({"dot_xy_px": [[[30.0 * x, 23.0 * y] for x in range(20)] for y in range(20)]}, "found:    400"),
        ({"dot_xy_px": [[570.0, 40.0 * y + 20.0] for y in range(9)]}, "too few dots next to the window"),
        ({"dot_xy_px": [[1.0, "2"], *FEW]}, "expected a number"),
        ({"dot_xy_px": []}, "dot_xy_px: wrong number of entries"),
        ({"dot_xy_px": FEW, "turned_deg": 1.0}, "dots are given twice"),
        ({"dot_columns_px": [-90.0, 100.0, 200.0]}, "a dot is outside the frame"),
        ({"hot_pixel_table": {**HOT, "x_px": [3]}}, "lists of different lengths"),
        ({"hot_pixel_table": {**HOT, "x_px": [3, 3], "y_px": [4, 4]}}, "is listed twice"),
        ({"hot_pixel_table": {**HOT, "on_share": [0.95, 0.5]}}, "changes its polarity too often"),
        ({"hot_pixel_table": {**HOT, "rate_hz": [50.0, 2600.0]}}, "too many events for its dead time"),
        ({"hot_pixel_table": {**HOT, "rate_hz": [0.0, 9.0]}}, "hot_pixel_table.rate_hz.0: out of range"),
        ({"hot_pixel_table": {"x_px": [3]}}, "keys are missing in hot_pixel_table"),
    ],
)
def test_what_is_wrong_is_said(keys: dict[str, Any], says: str, tmp_path: Path) -> None:
    """Assert that what cannot be a sensor is refused with its place, at exit code 2."""
    with pytest.raises(InputError) as refused:
        named_sensor(written(tmp_path, **keys))
    assert says in str(refused.value)
    assert "mine.sensor.toml" in str(refused.value)


def test_a_sensor_without_base_needs_all_keys(tmp_path: Path) -> None:
    """Assert that a file that is like no sensor is told what it lacks."""
    path = tmp_path / "bare.toml"
    path.write_text("noise_hz = 0.1\n")
    with pytest.raises(InputError, match="keys are missing") as refused:
        named_sensor(str(path))
    assert "threshold" in str(refused.value) and "like" in str(refused.value)


def test_no_file(tmp_path: Path) -> None:
    """Assert that a missing file, and one that is no TOML, are refused with their name."""
    with pytest.raises(InputError, match=r"none\.toml"):
        named_sensor(str(tmp_path / "none.toml"))
    (tmp_path / "odd.toml").write_text("[[[")
    with pytest.raises(InputError, match="not valid TOML"):
        named_sensor(str(tmp_path / "odd.toml"))


def test_the_recipe_hangs_on_the_content(tmp_path: Path) -> None:
    """Assert that another file of the same content, or like another sensor of the same row, is the same recipe."""

    def recipe_id(sensor: str) -> str:
        (job, *_) = record.jobs([], Record(scene="press", sensor=sensor), tmp_path)
        return simulated.make_recipe(job).id

    first = recipe_id(written(tmp_path, "one", noise_hz=0.5, summary="mine"))
    assert recipe_id(written(tmp_path, "two", noise_hz=0.5, summary="mine")) == first
    assert recipe_id(written(tmp_path, "two", noise_hz=0.6, summary="mine")) != first
    whole = tmp_path / "whole.toml"
    whole.write_text(as_toml({**as_table(one_sensor("evetac")), "noise_hz": 0.5, "summary": "mine"}))
    assert recipe_id(str(whole)) == first
