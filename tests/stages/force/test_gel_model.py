"""Forces of any sensor: closed forms of a pressed and sheared layer, other grids, adaptation, hostile input.

The recordings are made up: a face over the whole gel moves all dots alike, by force x height / (modulus x area), and
its pressure spreads them as `spread` says.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli import resources
from evetac_cli.commands.evaluate import EvaluateForce
from evetac_cli.commands.predict_force import PredictForce
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.evaluate import force as evaluate_force
from evetac_cli.inspect import info
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.gel import gel
from evetac_cli.sim.scenes.shared import pad
from evetac_cli.sim.setup.plan import first_plan, one_sensor
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.sim.setup.solver import Solver
from evetac_cli.stages.force import adapt_gel, predict_force, train_force
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import run_valid
from tests.stages.force.dots_and_forces import write_trial

SLICES, PRESSED = 2000, slice(300, 1700)
HEIGHT_M = gel.GelMaterial().height_m
NORMAL_N = 12.0
TRAIN = TrainForce(method="gel", contacts=12, epochs=1)
ADAPT = TrainForce(adapt="shipped")


def sensor_of(stiffer: float = 1.0) -> Sensor:
    usual = one_sensor("evetac")
    shear_pa, normal_pa = (stiffer * modulus_pa for modulus_pa in (usual.shear_modulus_pa, usual.normal_modulus_pa))
    return replace(usual, shear_modulus_pa=shear_pa, normal_modulus_pa=normal_pa)


def spread(rest_m: Any, node_xy_m: Any, depth_m: float) -> Any:
    """Shift (dots, 2) of dots under a face that presses the nodes (2, n) by depth_m, as the shipped model learned it.

    That model learned from a layer that spreads a patch evenly, more across its shorter side, whatever sticks; the
    simulator's does not, and a model that learns from it will need its own motion of dots here.
    """
    half_m = np.ptp(node_xy_m, axis=1) / 2 * np.array([24 / 23, 18 / 17])  # half a cell more than the nodes
    across = 0.3 * 0.75 / HEIGHT_M * depth_m * (half_m**2)[::-1] / (half_m**2).sum()
    middle_m = node_xy_m.mean(axis=1)
    from_middle = rest_m - middle_m
    inside = np.clip(from_middle, -half_m, half_m)
    fades = np.exp(-np.linalg.norm(from_middle - inside, axis=1) / 2.3e-3)
    return across * inside * fades[:, None] + rest_m * (depth_m / 25e-3)


def tracks_of_press(
    folder: Path,
    number: int,
    *,
    stiffer: float = 1.0,
    grid_px: Any = None,
    normal_n: float = NORMAL_N,
    name: str = "evetac",
    truth: bool = True,
    smaller: int = 1,
) -> Path:
    """A recording without events, its truth and the tracks of its dots, on a smaller frame; the path of the tracks."""
    sensor = sensor_of(stiffer)
    grid = np.array(dot_grid(sensor, cut=False) if grid_px is None else grid_px)
    rest_px = grid.reshape(-1, 2)
    nodes = pad(Solver(), sensor, cut=False)
    columns = nodes.reshape(-1, 2).T
    area_m2 = np.ptp(columns[0]) * np.ptp(columns[1]) * 24 * 18 / (23 * 17)  # about a cell more than between nodes
    rng = np.random.default_rng(number)
    time = np.arange(SLICES)
    knots = rng.uniform(-6, 6, (6, 2))
    at = np.linspace(PRESSED.start, PRESSED.stop, len(knots))
    pressed = (time >= PRESSED.start) & (time < PRESSED.stop)
    shear_n = pressed[:, None] * np.stack([np.interp(time, at, knots[:, axis]) for axis in (0, 1)], axis=1)
    if not normal_n:
        shear_n[:] = 0.0
    depth_m = np.full(nodes.shape[:2], normal_n * HEIGHT_M / (sensor.normal_modulus_pa * area_m2))
    rest_m = (rest_px - [320, 240]) * sensor.mm_per_px * 1e-3
    spread_m = spread(rest_m, columns, depth_m[0, 0])
    shift_m = shear_n * HEIGHT_M / (sensor.shear_modulus_pa * area_m2)
    moved_m = shift_m[:, None] + pressed[:, None, None] * spread_m
    dots = (rest_px + moved_m * 1e3 / sensor.mm_per_px).astype(np.float32)
    planned = replace(first_plan("press"), sensor=sensor)
    made = Recipe("recording", 1, {**planned.parameters(), "dots": len(rest_px)}, seed=number, simulated_source=truth)
    frame_px = (640 // smaller, 480 // smaller)
    return write_trial(folder, made, grid / smaller, dots / smaller, normal_n * pressed, shear_n, name, frame_px)


def predicted(path: Path, chosen: PredictForce, out: Path) -> dict[str, Any]:
    output, _ = run_valid(predict_force, [path], chosen, out)
    with StageFile(output) as file:
        return {name: file.read(name) for name in file.contents() if "/" not in name}


def true_shear(path: Path) -> Any:
    with StageFile(path.with_name(path.name.replace("tracks", "recording"))) as recording:
        return recording.read("truth/shear_force_n")


def own_sensor(folder: Path, stiffer: float, smaller: int = 1) -> str:
    path = folder / f"{stiffer}.sensor.toml"
    sensor = sensor_of(stiffer)
    values = {
        "mm_per_px": sensor.mm_per_px * smaller,
        "shear_modulus_pa": sensor.shear_modulus_pa,
        "normal_modulus_pa": sensor.normal_modulus_pa,
    }
    lines = [f"{key} = {value}" for key, value in values.items()]
    path.write_text("\n".join(['like = "evetac"', *lines, "[creep]", "share = [0.0]", "time_s = [1.0]"]))
    return str(path)


def close(estimated: dict[str, Any], true: Any, stiffness: float = 1.0) -> None:
    """Assert shear within 8 % of 6 N, normal force within 15 %, contact as it is, but where forces jump."""
    assert np.abs(estimated["shear_n"] / stiffness - true)[PRESSED].max() < 0.5
    assert np.abs(estimated["normal_n"] / stiffness - NORMAL_N)[PRESSED].max() < 0.15 * NORMAL_N
    assert estimated["contact"][PRESSED].all()
    assert not estimated["contact"][: PRESSED.start].any()
    assert not estimated["contact"][PRESSED.stop :].any()


@pytest.mark.parametrize("stiffer", [1.0, 0.6])
def test_closed_form_of_a_known_gel(tmp_path: Path, stiffer: float) -> None:
    """Assert the forces of a face over the whole gel, within 0.5 N of shear and 15 % of the normal force."""
    path = tracks_of_press(tmp_path, 0, stiffer=stiffer)
    estimated = predicted(path, PredictForce(sensor=own_sensor(tmp_path, stiffer)), tmp_path)
    close(estimated, true_shear(path))
    assert (estimated["normal_sd_n"][PRESSED] < 0.25 * NORMAL_N).all()


def test_an_unknown_gel_is_told_with_wide_bounds(tmp_path: Path) -> None:
    """Assert that the gel alone decides the force of a displacement, and that the sd covers half to twice of it."""
    path = tracks_of_press(tmp_path, 0)
    known = predicted(path, PredictForce(sensor=own_sensor(tmp_path, 1.0)), tmp_path / "known.forces.h5")
    unknown = predicted(path, PredictForce(), tmp_path / "unknown.forces.h5")
    far = np.abs(known["shear_n"]) > 3
    assert 0.6 < np.median(unknown["shear_n"][far] / known["shear_n"][far]) < 1.4
    assert (unknown["shear_sd_n"][far] > 2 * known["shear_sd_n"][far]).all()
    assert (np.abs(unknown["shear_n"] - true_shear(path))[far] < 2 * unknown["shear_sd_n"][far]).all()
    at_rest = slice(0, PRESSED.start)
    assert unknown["shear_sd_n"][at_rest].max() < 0.3


@pytest.mark.parametrize("pitch_px", [45.0, 85.0])
def test_other_grids(tmp_path: Path, pitch_px: float) -> None:
    """Assert the same bounds for denser and sparser dots than any that the model was trained on."""
    x, y = np.arange(30.0, 620, pitch_px), np.arange(25.0, 460, pitch_px)
    path = tracks_of_press(tmp_path, 0, grid_px=np.stack(np.meshgrid(x, y), axis=-1))
    estimated = predicted(path, PredictForce(sensor=own_sensor(tmp_path, 1.0)), tmp_path)
    close(estimated, true_shear(path))


@pytest.mark.parametrize("smaller", [2, 4])
def test_the_scale_of_another_frame_has_to_be_known(tmp_path: Path, smaller: int) -> None:
    """Assert that forces on a smaller frame are refused until its scale is known, and then those of a whole one."""
    path = tracks_of_press(tmp_path, 0, smaller=smaller)
    (tmp_path / "gel.sensor.toml").write_text('like = "evetac"\nshear_modulus_pa = 1e5\n')
    for stage, chosen in (
        (predict_force, PredictForce()),
        (predict_force, PredictForce(sensor=str(tmp_path / "gel.sensor.toml"))),
        (train_force, ADAPT),
    ):
        with pytest.raises(InputError, match=r"the scale of this frame(.|\n)*mm_per_px"):
            run_valid(stage, [path], chosen, tmp_path / "refused.h5")
    assert not (tmp_path / "refused.h5").exists()
    known = own_sensor(tmp_path, 1.0, smaller)
    close(predicted(path, PredictForce(sensor=known), tmp_path), true_shear(path))
    own, _ = run_valid(train_force, [path], replace(ADAPT, sensor=known), tmp_path / "own.force-model.h5")
    close(predicted(path, PredictForce(model=own), tmp_path / "adapted.forces.h5"), true_shear(path))


def test_lost_dots(tmp_path: Path) -> None:
    """Assert that forces stay where some dots are lost and have no value where all are; the rest is unharmed."""
    path = tracks_of_press(tmp_path, 0)
    lost = tmp_path / "lost"
    lost.mkdir()
    with StageFile(path) as file:
        header = file.header
        arrays = {name: file.read(name) for name in file.contents()}
    arrays["dot_xy_px"] = arrays["dot_xy_px"].copy()
    arrays["lost"] = arrays["lost"].copy()
    arrays["lost"][500:600] = 1
    arrays["lost"][600:, ::6] = 1
    arrays["dot_xy_px"][600:, ::6] = 0.0
    write_stage(lost / "trial0.tracks.h5", Recipe("tracks", 1, {"preset": "lost"}, parents=(header,)), arrays)
    estimated = predicted(lost / "trial0.tracks.h5", PredictForce(sensor=own_sensor(tmp_path, 1.0)), lost)
    assert np.isnan(estimated["shear_n"][500:600]).all()
    assert np.isnan(estimated["contact_probability"][500:600]).all()
    assert not estimated["contact"][500:600].any()
    assert np.isfinite(estimated["shear_n"][600:]).all()
    assert np.abs(estimated["shear_n"] - true_shear(path))[600 : PRESSED.stop].max() < 0.7


def test_no_contact(tmp_path: Path) -> None:
    """Assert that a gel at rest has no contact and no force, and cannot be adapted to."""
    path = tracks_of_press(tmp_path, 0, normal_n=0.0)
    estimated = predicted(path, PredictForce(), tmp_path)
    assert not estimated["contact"].any()
    assert np.abs(estimated["shear_n"]).max() < 0.1
    assert estimated["normal_n"].max() < 0.5
    with pytest.raises(InputError, match="no reading is during a contact"):
        run_valid(train_force, [path], ADAPT, tmp_path)


@pytest.mark.slow
def test_adaptation_finds_the_gel(tmp_path: Path) -> None:
    """Assert that known forces make an unknown gel known, from truth as from a table, and evaluate says so."""
    own = [tracks_of_press(tmp_path, number, stiffer=1.6) for number in (1, 2, 3)]
    model, outcome = run_valid(train_force, own, ADAPT, tmp_path)
    assert model.name == "own.force-model.h5"
    assert outcome.rows[0]["contacts"] == 3
    assert outcome.rows[0]["shear_modulus_kpa"] == pytest.approx(1.6 * 145, rel=0.1)
    assert outcome.rows[0]["normal_modulus_kpa"] == pytest.approx(1.6 * 1000, rel=0.15)
    assert outcome.rows[0]["shear_error_factor"] == outcome.rows[0]["normal_error_factor"] == 1.0
    path = tracks_of_press(tmp_path, 4, stiffer=1.6)
    estimated = predicted(path, PredictForce(model=model), tmp_path / "a.forces.h5")
    close(estimated, true_shear(path))
    assert info.run([model, tmp_path / "a.forces.h5"]).rows[0]["dots"] == "any grid"
    for one in own:
        rows = [f"{at / 1000},{x},{y},{NORMAL_N}" for at, (x, y) in enumerate(true_shear(one)) if 300 <= at < 1700]
        one.with_name(one.name.replace("tracks.h5", "force.csv")).write_text(
            "\n".join(["t_s,shear_x_n,shear_y_n,normal_n", *rows])
        )
    table, outcome = run_valid(train_force, own, ADAPT, tmp_path / "table.force-model.h5")
    assert outcome.rows[0]["shear_modulus_kpa"] == pytest.approx(1.6 * 145, rel=0.1)
    for one in own:
        one.with_name(one.name.replace("tracks.h5", "force.csv")).unlink()
    identified = tmp_path / "identified"
    identified.mkdir()
    Path(own_sensor(tmp_path, 1.6)).rename(identified / "evetac.sensor.toml")
    chosen = EvaluateForce(
        model=str(resources.FORCE_MODEL),
        adapt_on=str(tmp_path / "trial[123].tracks.h5"),
        identified=str(identified),
    )
    report, outcome = run_valid(evaluate_force, [path], chosen, tmp_path / "r.report.h5")
    errors = {row["stiffness"]: row["mae_n"] for row in outcome.rows}
    assert list(errors) == ["unknown", "known", "identified", "adapted", "known, adapted", "identified, adapted"]
    assert errors["identified"] < 0.3
    assert errors["adapted"] < 0.2 * errors["unknown"]
    assert errors["adapted"] < 0.3
    assert outcome.rows[3]["contact_right"] > 0.99
    assert outcome.rows[3]["normal_mae_of_range"] < 0.1
    assert outcome.summary["identified_sensors"] == 1
    assert report.with_suffix(".png").stat().st_size > 10_000
    resting = tracks_of_press(tmp_path, 5, stiffer=1.6, normal_n=0.0)
    _, outcome = run_valid(train_force, [*own, resting], ADAPT, tmp_path / "resting.force-model.h5")
    assert outcome.rows[0]["contacts"] == 3 and outcome.rows[0]["without_readings"] == "trial5.tracks.h5"
    second = tracks_of_press(tmp_path, 6, name="second")
    softer = tracks_of_press(tmp_path, 7)
    predicted(tracks_of_press(tmp_path, 8, name="unknown"), PredictForce(model=model), tmp_path / "unknown.forces.h5")
    for stage, files, wrong, message in (
        (predict_force, [second], PredictForce(model=model), "another sensor than the model was adapted to"),
        (evaluate_force, [path, softer], EvaluateForce(model=str(resources.FORCE_MODEL)), "two sensors of the name"),
        (train_force, own, TrainForce(adapt=str(model)), "adapted already"),
        (predict_force, [path], PredictForce(model=model, sensor="evetac"), "stiffness of its sensor"),
        (evaluate_force, [path], EvaluateForce(model=str(model)), "adapted to one sensor"),
        (evaluate_force, [path], EvaluateForce(model=str(tmp_path)), "among several"),
        (evaluate_force, [path], replace(chosen, identified=str(tmp_path / "none")), "no file of a sensor"),
    ):
        with pytest.raises(InputError, match=message):
            run_valid(stage, files, wrong, tmp_path / "refused.h5")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a table of forces"),
        ("t,fx,fy,fz\n0,1,2,3", "not a table of forces"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n", "without a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.4,1,2", "not a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.4,1,inf,3", "not a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n,1,2,3", "not a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n9.4,1,2,3", "beside the recording"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.4,,,\n", "without a reading"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.1,1,,\n", "no reading is during a contact"),
        ("t_s,shear_x_n,shear_y_n,normal_n\n0.4,1,2,\0", "bytes of value 0"),
        pytest.param("t_s,shear_x_n,shear_y_n,normal_n\n0.4,1,2," + "1" * 200_000, "field larger", id="large field"),
    ],
)
def test_tables_that_are_none(tmp_path: Path, text: str, message: str) -> None:
    """Assert that a table without readings, or with senseless ones, is refused in words."""
    path = tracks_of_press(tmp_path, 0, truth=False)
    with pytest.raises(InputError, match="no known forces"):
        run_valid(train_force, [path], ADAPT, tmp_path)
    path.with_name("trial0.force.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        run_valid(train_force, [path], ADAPT, tmp_path)


def test_contacts_are_numbered_over_time() -> None:
    """Assert that a contact is a stretch of time: short gaps do not divide it, short touches are none, none is none."""
    touches = np.zeros(3000, np.bool_)
    for begin, end in ((100, 500), (600, 900), (1200, 1350), (2000, 3000)):
        touches[begin:end] = True
    numbers = adapt_gel.contact_numbers(touches)
    assert (numbers[100:900] == 0).all()
    assert (numbers[2000:] == 1).all()
    assert (np.delete(numbers, [*range(100, 900), *range(2000, 3000)]) == -1).all()
    assert (adapt_gel.contact_numbers(np.zeros(50, np.bool_)) == -1).all()
    assert adapt_gel.contact_numbers(touches[:0]).shape == (0,)


def test_two_contacts_with_a_reading_each(tmp_path: Path) -> None:
    """Assert that readings a second apart are of two contacts where the gel was let go between them."""
    path = tracks_of_press(tmp_path, 1)
    with StageFile(path) as file:
        header, arrays = file.header, {name: file.read(name) for name in file.contents()}
    arrays["dot_xy_px"][800:1100] = arrays["dot_xy_px"][0]
    own = tmp_path / "own"
    own.mkdir()
    write_stage(own / path.name, Recipe("tracks", 1, {"preset": "let go"}, parents=(header,)), arrays)
    table = own / "trial1.force.csv"
    counts = []
    for between in ("", "1.0,0,0,0\n"):
        table.write_text(f"t_s,shear_x_n,shear_y_n,normal_n\n0.6,0,0,\n{between}1.2,0,0,\n")
        counts.append(
            run_valid(train_force, [own / path.name], ADAPT, own / f"{len(counts)}.force-model.h5")[1].rows[0]
        )
    assert [row["contacts"] for row in counts] == [2, 2]
    assert [row["readings"] for row in counts] == [2, 2]


@pytest.mark.slow
def test_training_is_the_same_for_one_seed(tmp_path: Path) -> None:
    """Assert that the same seed gives the same arrays and another seed others, and that two sensors are not mixed."""
    tracks = [tracks_of_press(tmp_path, number) for number in (1, 2)]
    arrays = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        chosen = TrainForce(method="gel", contacts=TRAIN.contacts, epochs=1, seed=seed)
        path, outcome = run_valid(train_force, tracks, chosen, tmp_path / f"{name}.force-model.h5")
        assert outcome.rows[0]["trajectories"] == 2
        with StageFile(path) as file:
            arrays.append({key: file.read(key) for key in file.contents()})
    assert all(np.array_equal(arrays[0][key], arrays[1][key]) for key in arrays[0])
    assert not np.array_equal(arrays[0]["gel/0/weight"], arrays[2]["gel/0/weight"])
    with pytest.raises(InputError, match="not of the paper's method"):
        train_force.read_model(tmp_path / "a.force-model.h5")
    other = tracks_of_press(tmp_path, 3, name="second")
    with pytest.raises(InputError, match="different sensors"):
        run_valid(train_force, [*tracks, other], ADAPT, tmp_path)
    real = tracks_of_press(tmp_path, 4, truth=False)
    with pytest.raises(InputError, match="no truth"):
        run_valid(train_force, [real], TRAIN, tmp_path)
