"""What is refused of scenes, sensors, objects and their flags, each with the file or the flag and the key."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.simulated import rig
from evetac_cli.errors import InputError, SceneError
from evetac_cli.sim.setup import object_file, scene_file
from evetac_cli.sim.setup.plan import Plan, first_plan, named_sensor, one_sensor, plans, read_plan, with_second
from evetac_cli.sim.setup.scene import KINDS
from evetac_cli.sim.setup.scene_file import merged
from evetac_cli.sim.setup.sensor_file import of_row
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.text_files import as_toml, read_toml

FEW = [[100.0, 100.0], [200.0, 100.0], [100.0, 200.0], [230.0, 230.0]]
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
SHAKES = {"frequency_hz": [20.0], "acceleration_m_s2": [0.5]}
CAN = {"shape": "cylinder", "mass_g": 350, "width_mm": 66, "height_mm": 115, "static_friction": 0.8}

# Changes of a sensor that is like `evetac`, and the key that is named.
SENSORS: list[tuple[dict[str, Any], str]] = [
    ({"noise": 1.0}, "did you mean noise_hz"),
    ({"gripper": {"mass": 1.0}}, "gripper.mass"),
    ({"noise_hz": "much"}, "noise_hz"),
    ({"noise_hz": True}, "noise_hz"),
    ({"noise_hz": math.nan}, "noise_hz"),
    ({"bandwidth_by_light": "yes"}, "bandwidth_by_light"),
    ({"distortion": [0.1]}, "distortion"),
    ({"readout": {"events_per_s": 10.0}}, "readout.events_per_s"),
    ({"hot_pixels": 1.5}, "hot_pixels"),
    ({"hot_pixel_hz": [1.0] * 5000}, "hot_pixel_hz"),
    ({"hot_pixel_hz": [9.0, 1.0]}, "hot_pixel_hz"),
    ({"window_px": [640, 0, 540, 480]}, "window_px"),
    ({"frame_px": [320, 240]}, "frame_px"),
    ({"like": "evtac"}, "did you mean evetac"),
    ({"like": "randomized"}, "like"),
    ({"like": None}, "threshold"),
    ({"name": "second"}, "name"),
    ({"name": "A name"}, "name"),
    ({"gripper": {"servo_n_tick": 2.0}}, "two_ticks_n"),
    ({"like": "randomized:7", "gripper": {"gain_ma_tick": 5.0}}, "gain_ma_tick"),
    ({"friction": {"patch_spread": 0.1}}, "patch_mm"),
    ({"creep": {"share": [0.1], "time_s": [1.0, 2.0]}}, "creep.time_s"),
    ({"dot_xy_px": [[[1.0, 2.0], [3.0, 4.0]], [[1.0, 9.0], [3.0, 9.0], [5.0, 9.0]]]}, "dot_xy_px"),
    ({"dot_xy_px": [*FEW, [217.0, 100.0]]}, "two dots overlap"),
    ({"dot_xy_px": [*FEW, [600.0, 9.0]], "distortion": [0.3, 0.3]}, "a dot is outside the frame"),
    ({"dot_xy_px": [*FEW, [650.0, 100.0]]}, "dot_xy_px.0.4.0"),
    ({"dot_xy_px": FEW[:1]}, "4 to 256 dots"),
    ({"dot_xy_px": [[[30.0 * x, 23.0 * y] for x in range(20)] for y in range(20)]}, "4 to 256 dots"),
    ({"dot_xy_px": [[570.0, 40.0 * y + 20.0] for y in range(9)]}, "window_px"),
    ({"dot_xy_px": [[1.0, "2"], *FEW]}, "dot_xy_px"),
    ({"dot_xy_px": []}, "dot_xy_px"),
    ({"dot_xy_px": FEW, "turned_deg": 1.0}, "turned_deg"),
    ({"hot_pixel_table": {**HOT, "x_px": [3]}}, "hot_pixel_table"),
    ({"hot_pixel_table": {**HOT, "rate_hz": [50.0, 2600.0]}}, "dead_time_us"),
    ({"hot_pixel_table": {"x_px": [3]}}, "hot_pixel_table"),
]
# Changes of a can.
OBJECTS: list[tuple[dict[str, Any], str]] = [
    ({"widht_mm": 60}, "did you mean width_mm"),
    ({"shape": "cyllinder"}, "did you mean cylinder"),
    ({"mass_g": None, "height_mm": None}, "mass_g, height_mm"),
    ({"static_friction": None}, "static_friction"),
    ({"mass_g": 0.35}, "mass_g"),  # in kilograms
    ({"mass_g": "350 g"}, "mass_g"),
    ({"width_mm": 0.066}, "width_mm"),  # in metres
    ({"width_mm": 150}, "104.8 mm"),
    ({"static_friction": 0.01}, "static_friction"),
    ({"static_friction": 6}, "static_friction"),
    ({"tilt_deg": 45}, "tilt_deg"),
    ({"tilt_deg": [3, 1]}, "tilt_deg"),
    ({"name": "8"}, "name"),
]
# Changes of packaged scenes: values that no scene has, keys that a kind needs, and parts of another kind.
SCENES: list[tuple[str, dict[str, Any], str]] = [
    ("data-rate", {"time": {"restt_s": 0.1}}, "did you mean rest_s"),
    ("data-rate", {"randomise": {"mass": None, "masss": [1.0, 1.0]}}, "did you mean mass"),
    ("data-rate", {"kind": "rampp"}, "kind"),
    ("slip", {"solver": {"node_pitch_mm": 0.0}}, "solver.node_pitch_mm"),
    ("slip", {"solver": {"step_ms": math.nan}}, "solver.step_ms"),
    ("slip", {"solver": {"step_ms": 0.3}}, "step_ms"),
    ("slip", {"solver": {"step_ms": 0.5, "tolerance_um": 0.1}}, "solver"),
    ("slip", {"randomise": {"mass": "heavy"}}, "randomise.mass"),
    ("slip", {"randomise": {"memory_um": [50.0, 20.0]}}, "randomise.memory_um"),
    ("slip", {"randomise": {"pressure_exponent": 1.5}}, "randomise.pressure_exponent"),
    ("data-rate", {"push": {"force_n": [1.0]}}, "push.force_n"),
    ("slip", {"light": {}}, "light"),
    ("slip", {"light": {"flicker": {"frequency_hz": 100.0}}}, "depth"),
    ("slip", {"vanishing_dots": {"dots": [], "at_s": 0.0}}, "vanishing_dots.dots"),
    ("slip", {"gripper": {"second_finger": {}}}, "gripper.second_finger"),
    ("slip", {"hand": {}}, "hand"),
    ("slip", {"hand": {"vibration": {**SHAKES, "acceleration_m_s2": [1.0, 1.0]}}}, "hand.vibration.acceleration_m_s2"),
    ("slip", {"hand": {"vibration": {"frequency_hz": [20.0]}}}, "acceleration_m_s2"),
    ("lift", {"hand": {"profile": "square"}}, "hand.profile"),
    ("edge", {"rub": {"edge_blur_px": [1000.0, 1000.0]}}, "rub.edge_blur_px.0"),  # drawing it takes many seconds
    ("vibration", {"tone": {"second_harmonic_least": [99.0] * 100}}, "tone.second_harmonic_least"),
    ("vibration", {"tone": {"frequency_hz": []}}, "tone.frequency_hz"),
    ("vibration", {"tone": {"modulation_most": [0.3]}}, "tone.modulation_most"),
    ("vibration", {"tone": {"tangential_share": [0.6, 0.2]}}, "tone.tangential_share"),
    ("shear", {"face": {"radius_mm": 8.0}}, "face"),
    ("shear", {"face": {"size_mm": None}}, "face"),
    *(("slip", {"time": {key: None}}, f"time.{key}") for key in ("rest_s", "load_s", "hold_s", "longest_s")),
    *(("data-rate", {"time": {key: None}}, f"time.{key}") for key in ("rest_s", "load_s", "longest_s")),
    ("data-rate", {"gripper": {"open_ticks": None}}, "gripper.open_ticks"),
    ("lift", {"time": {"touch_s": None}}, "time.touch_s"),
    *(("lift", {"hand": {key: None}}, f"hand.{key}") for key in ("height_mm", "speed_mm_s", "acceleration_mm_s2")),
    *(("edge", {key: None}, key) for key in ("time", "rub")),
    *(("shear", {key: None}, key) for key in ("time", "face", "motion")),
    *(("shear", {"motion": {key: None}}, f"motion.{key}") for key in ("shear_n", "offset_mm", "count", "pause_s")),
    *(("press", {"motion": {key: None}}, f"motion.{key}") for key in ("lines", "speed_mm_s", "approach_s")),
    ("press", {"motion": {"pause_s": 1.0}}, "motion.pause_s"),
    ("slip", {"hand": {"jerk": {"at_s": 1.0, "speed_mm_s": 1.0, "lasts_s": 0.1}}}, "hand.jerk"),
    ("slip", {"hand": {"vibration": {**SHAKES, "only_moving": True}}}, "hand.vibration.only_moving"),
    ("shear", {"hand": {"vibration": SHAKES}}, "hand"),
    ("shear", {"gripper": {"backlash_ticks": 1.0}}, "gripper"),
    ("shear", {"gripper": {"second_finger": {"friction_factor": 0.7}}}, "gripper"),
    ("shear", {"object": {"mass_g": 5.0}}, "object"),
    ("vibration", {"friction_change": {"at_s": 1.0, "factor": 0.1}}, "friction_change"),
    ("slip", {"drop": {"mass_g": 1.0, "after_s": 1.0, "speed_m_s": 1.0}}, "drop"),
    ("data-rate", {"gripper": {"start_factor": [2.0, 2.0]}}, "gripper.start_factor"),
    ("data-rate", {"gripper": {"ramp_s": 13.0}}, "gripper.ramp_s"),
    ("data-rate", {"gripper": {"open_s": 5.0}}, "gripper.open_s"),
    ("grip-steps", {"gripper": {"start_n": 20.0}}, "gripper.start_n"),
    ("grip-steps", {"gripper": {"open_s": 30.0}}, "gripper.open_s"),
    ("grip-steps", {"gripper": {"current": {"at_s": [0.0, 0.0], "ma": [1.0, 2.0]}}}, "gripper.current.at_s"),
    ("grip-steps", {"time": {"longest_s": 35.0}}, "time.longest_s"),
    ("grip-steps", {"gripper": {"current": {"square": {"from_s": 12.0}}}}, "gripper.current.square"),
]
# Flags of `record` and `grasp` that choose what is simulated.
FLAGS: list[tuple[str, dict[str, Any], str]] = [
    *(("slip", {"objects": text}, "--object") for text in ("", "a", "3-", "5-3", "1;2", "-1", "can.tom", "99")),
    *(("slip", {"sensor": name}, "--sensor") for name in ("evtac", "randomized:", "randomized:-1", "second:1")),
    ("slip", {"sensor": "a.toml,b.toml"}, "--sensor"),
    ("slip", {"sensor": "none.toml"}, "none.toml"),
    ("slipp", {}, "did you mean slip"),
    ("none.toml", {}, "none.toml"),
    *((name, {"objects": "can.toml"}, "--object") for name in ("press", "shear", "rest", "edge", "vibration")),
    ("slip", {"gel": "closed", "texture": "on"}, "--texture"),
    ("press", {"texture": "off"}, "--texture"),
    ("slip", {"tones": "200"}, "--tone"),
    *(("vibration", {"tones": text}, "--tone") for text in ("", "x", "0.5", "2501", "nan", "200,,300", "-5")),
    ("lift", {"kinds": ("ramp",)}, "lift"),
    ("press", {"kinds": ("ramp", "hold")}, "virtual devices cannot show"),
    ("slip", {"solver": {"step_ms": 0.5, "tolerance_um": 0.1}}, "step_ms"),
    *(("slip", {"solver": {key: 0.0}}, key) for key in ("step_ms", "tolerance_um", "theta", "camera_substeps")),
]
# Values of a recording's header in which no plan is.
HEADERS = [
    *(("scene", value) for value in (None, 3, [], {}, {"kind": "ramp"})),
    *(("sensor_row", value) for value in (None, "x", {}, {"seed": 1})),
    *(("object_row", value) for value in (3, {}, {"shape": "torus"})),
    *(("sensor", 3), ("object", {}), ("tone_hz", "x"), ("sensor_ranges", 1)),
]
# Scenes of valid values that no simulation can be made of, or that would take more than a day.
IMPOSSIBLE: list[tuple[str, dict[str, Any]]] = [
    ("shear", {"randomise": {"kinetic_share": [5.0, 5.0]}}),
    ("vibration", {"tone": {"radius_mm": 1e-300}}),
    ("slip", {"gripper": {"start_factor": [1000.0, 1000.0]}}),
    ("slip", {"vanishing_dots": {"dots": [[7, 0]], "at_s": 0.3}}),
    ("slip", {"randomise": {"mass": [1000.0, 1000.0]}}),
    ("slip", {"texture": {"half_correlation_px": [1000.0, 1000.0]}}),
    ("press", {"motion": {"speed_mm_s": 1e-300}}),
    ("press", {"motion": {"approach_s": 3600.0, "lines": 100}}),
    ("shear", {"motion": {"count": 100_000}}),
    ("edge", {"rub": {"speed_mm_s": [1e-300, 1e-300]}}),
]


def written(folder: Path, keys: dict[str, Any]) -> str:
    path = folder / "mine.toml"
    path.write_text(as_toml({key: value for key, value in keys.items() if value is not None}))
    return str(path)


def changed(name: str, changes: dict[str, Any]) -> dict[str, Any]:
    return merged(read_toml(scene_file.SCENES / f"{name}.toml"), changes)


@pytest.mark.parametrize(("keys", "place"), SENSORS)
def test_sensors(keys: dict[str, Any], place: str, tmp_path: Path) -> None:
    """Assert that a file that is no sensor is refused with its name and the key."""
    with pytest.raises(InputError, match=place) as refused:
        named_sensor(written(tmp_path, {"like": "evetac", **keys}))
    assert refused.value.where.startswith(str(tmp_path))


@pytest.mark.parametrize(("keys", "place"), OBJECTS)
def test_objects(keys: dict[str, Any], place: str, tmp_path: Path) -> None:
    """Assert that a file that is no object for a gripper is refused with its name and the key."""
    with pytest.raises(InputError, match=place) as refused:
        object_file.read(Path(written(tmp_path, {**CAN, **keys})))
    assert refused.value.where.startswith(str(tmp_path))


@pytest.mark.parametrize(("name", "changes", "place"), SCENES)
def test_scenes(name: str, changes: dict[str, Any], place: str, tmp_path: Path) -> None:
    """Assert that a file that is no scene is refused with its name and the key."""
    with pytest.raises(SceneError, match=place) as refused:
        scene_file.load(written(tmp_path, changed(name, changes)))
    assert refused.value.where.startswith(str(tmp_path))


@pytest.mark.parametrize("content", [b"shape = ", b"\xff\xfe\x00", b"[" * 9000, b"", b"a.b.c = 1\n", None])
def test_files_that_are_none_of_them(content: bytes | None, tmp_path: Path) -> None:
    """Assert that a missing file, broken TOML, binary and keys of nothing are refused with the file's name."""
    path = tmp_path / "mine.toml"
    if content is not None:
        path.write_bytes(content)
    for read in (named_sensor, scene_file.load, lambda name: object_file.read(Path(name))):
        with pytest.raises(InputError) as refused:
            read(str(path))
        assert refused.value.where.startswith(str(path))


@pytest.mark.parametrize(("name", "flags", "place"), FLAGS)
def test_flags(name: str, flags: dict[str, Any], place: str) -> None:
    """Assert that flags that name nothing, or contradict the scene, are refused by name."""
    with pytest.raises(InputError, match=place):
        first_plan(name, **flags)


def test_a_second_camera_needs_a_gripper() -> None:
    """Assert that a scene without a gripper has no place for a second sensor."""
    with pytest.raises(InputError, match="--camera"):
        with_second(plans("press", "8", "evetac", KINDS)[0], "evetac")


@pytest.mark.parametrize(("key", "value"), HEADERS)
def test_headers(key: str, value: Any) -> None:
    """Assert that a header with anything else in a place of the plan is refused with the file's name."""
    with pytest.raises(InputError) as refused:
        read_plan({**first_plan("slip").parameters(), key: value}, "file")
    assert refused.value.where.startswith("file")


@pytest.mark.parametrize(("name", "changes"), IMPOSSIBLE)
def test_scenes_that_cannot_be_simulated(name: str, changes: dict[str, Any], tmp_path: Path) -> None:
    """Assert that valid values that do not go together are refused when it is built."""
    planned: Plan = first_plan(written(tmp_path, changed(name, changes)))
    with pytest.raises(SceneError, match=f"scene {name}|too long"):
        rig(planned, np.random.SeedSequence(0))


def test_a_row_without_dots() -> None:
    """Assert that a row needs either the positions of its dots, or columns and rows."""
    row = {key: value for key, value in as_table(one_sensor("evetac")).items() if key != "dot_rows_px"}
    with pytest.raises(InputError, match="dot_rows_px, or dot_xy_px"):
        of_row(row, "here")
