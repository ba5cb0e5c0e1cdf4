"""Plug-ins: a package from outside is used from the command line, and broken ones are refused in words."""

import importlib.util
import json
import os
import pickle
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli import plugins
from evetac_cli.cli import dask_engine, exit_codes, main
from evetac_cli.devices import cameras, grippers
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.errors import InputError
from evetac_cli.formats import exports, imports
from evetac_cli.formats.imports import ImportFormat, read_events
from evetac_cli.formats.read.source import EventColumns, EventSource
from evetac_cli.inspect import doctor
from evetac_cli.kernels.grip.control import PluginLaw
from evetac_cli.kernels.grip.load_law import MARGIN
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import time_host_versions
from evetac_cli.trials.grasp import settings
from tests.conftest import Add, Made
from tests.patience import PATIENCE_S

TOY = PACKAGE.parent / "tests" / "plugin"
GROUPS = tomllib.loads((TOY / "pyproject.toml").read_text())["project"]["entry-points"]

# Packages that cannot be used, each for another reason.
BROKEN = {
    "evetac-absent": {"evetac.cameras": {"absent": "no_such_module:Camera"}},
    "evetac-dies": {"evetac.cameras": {"dies": "evetac_dies:Camera"}},
    "evetac-other": {"evetac.cameras": {"other": "json:JSONDecoder"}, "evetac.grippers": {"mine": "evetac_dies:X"}},
    "evetac-taken": {"evetac.cameras": {"sim": "json:JSONDecoder"}, "evetac.grippers": {"mine": "evetac_dies:X"}},
    "evetac-named": {"evetac.scenes": {"Grand Scene": "json"}},
}


def install(folder: Path, package: str, groups: Mapping[str, Mapping[str, str]]) -> None:
    """What pip leaves of a package beside its modules, so far as it tells of entry points."""
    about = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    with (about / "entry_points.txt").open("w") as file:
        for group, entries in groups.items():
            print(f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()), sep="\n", file=file)


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of installed packages: the one from outside."""
    folder = tmp_path_factory.mktemp("toy")
    shutil.copytree(TOY, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    install(folder, "evetac-toy", GROUPS)
    return folder


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of installed packages that cannot be used."""
    folder = tmp_path_factory.mktemp("broken")
    for package, groups in BROKEN.items():
        install(folder, package, groups)
    (folder / "evetac_dies.py").write_text('raise OSError("no camera library on this machine")\n')
    return folder


def run(packages: Path, *arguments: str | Path, module: str = "evetac_cli") -> "subprocess.CompletedProcess[str]":
    """Run evetac where these packages are installed."""
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": f"{PACKAGE.parent}:{packages}", "HOME": str(packages)}
    command = [sys.executable, "-P", "-m", module, *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=packages, env=environment
    )


def rows(packages: Path, *arguments: str | Path) -> list[dict[str, Any]]:
    """The rows that a command prints; it ends well."""
    done = run(packages, *arguments, "--json")
    assert done.returncode == 0, done.stderr
    printed: list[dict[str, Any]] = json.loads(done.stdout)["rows"]
    return printed


def refusal(packages: Path, *arguments: str | Path) -> str:
    """What a command says that refuses; exit code 2."""
    done = run(packages, *arguments)
    assert done.returncode == 2, (done.stdout, done.stderr)
    return done.stderr


def test_it_keeps_the_contracts(toy: Path) -> None:
    """Assert that the package passes its own tests, which are calls of evetac_cli.testing."""
    done = run(toy, "-q", "-p", "no:cacheprovider", toy / "tests", module="pytest")
    assert done.returncode == 0, done.stdout
    assert "passed" in done.stdout


def test_record_with_camera_and_gripper(toy: Path, tmp_path: Path) -> None:
    """Assert that a camera and a gripper of a plug-in are recorded, and that the header names their package."""
    out = tmp_path / "a.recording.h5"
    (row,) = rows(toy, "record", "--camera", "stripe:7", "--gripper", "still", "--seconds", "0.3", "-o", out)
    assert (row["slices"], row["events"]) == (300, 2100)
    with StageFile(out, "recording") as file:
        assert file.header["parameters"]["setup"]["camera"] == {"name": "stripe", "rows": 7}
        assert file.header["parameters"]["setup"]["gripper"] == {"name": "still", "mode": "current"}
        assert file.header["made"]["evetac-toy"] == "1.0"
        assert file.header["simulated"]
        assert set(file.read("gripper/position_ticks")) == {400}
    (row,) = rows(toy, "validate", out)
    assert row["valid"]


@pytest.mark.slow  # in real time
def test_grasp_in_real_time(toy: Path, tmp_path: Path) -> None:
    """Assert that camera, gripper and controller of a plug-in make a grasp in three processes."""
    (grid := tmp_path / "grid.json").write_text(
        json.dumps(
            {"frame_px": [640, 480], "radius_px": 15, "dot_xy_px": [[[99, 99], [199, 99]], [[99, 199], [199, 199]]]}
        )
    )
    named = ("--camera", "stripe:3", "--gripper", "still", "--controller", "blind", "--scene", "short-lift")
    took = ("--lift-s", "1", "--balance-s", "0", "--calibration", grid, "--watchdog-ms", "500")
    done = run(toy, "grasp", *named, *took, "-o", tmp_path / "a.recording.h5")
    assert done.returncode == 0 or "overloaded" in done.stderr  # a busy computer ends it early; what it did is kept
    with StageFile(tmp_path / "a.recording.h5", "recording") as file:
        assert file.header["parameters"]["controller"] == "blind"
        assert file.header["parameters"]["law"] == {"approach_ticks": 2, "step_ticks": 1.0}
        assert file.header["parameters"]["setup"]["gripper"]["name"] == "still"
        assert set(file.read("control/goal_ticks")) == {402}


@pytest.mark.slow  # in real time
@pytest.mark.parametrize(
    ("camera", "gripper", "said"),
    [
        ("bad:order", "hand", "camera bad of evetac-bad returned an invalid slice 30; torque is off"),
        ("bad:polarity", "hand:close", "invalid slice 30; torque could not be read back as off: OSError"),
    ],
)
def test_a_grasp_names_what_fails(tmp_path: Path, camera: str, gripper: str, said: str) -> None:
    """Assert that a fault of a plug-in ends a grasp with exit code 3 and the state of torque, and keeps its slices."""
    module = "tests.devices.test_plugin_devices"
    groups = {"evetac.cameras": {"bad": f"{module}:Bad"}, "evetac.grippers": {"hand": f"{module}:BadHand"}}
    install(tmp_path, "evetac-bad", groups)
    (grid := tmp_path / "grid.json").write_text(
        json.dumps({"frame_px": [64, 48], "radius_px": 3, "dot_xy_px": [[[9, 9], [29, 9]], [[9, 29], [29, 29]]]})
    )
    named = ("--camera", camera, "--gripper", gripper, "--controller", "none", "--calibration", grid)
    took = ("--lift-s", "1", "--balance-s", "0", "--watchdog-ms", "500")
    done = run(tmp_path, "grasp", *named, *took, "-o", tmp_path / "a.recording.h5", "--json")
    assert done.returncode == 3, done.stderr
    assert said in json.loads(done.stdout)["error"]["message"]
    with StageFile(tmp_path / "a.recording.h5", "recording") as file:
        assert file.length("events/t") > 0
        assert np.isfinite(file.read("gripper/current_ma")).all()


@pytest.mark.slow
def test_a_scene_is_recorded_exported_and_imported(toy: Path, tmp_path: Path) -> None:
    """Assert that a recording goes out in the format of a plug-in, and comes back from it event for event."""
    (made,) = rows(toy, "record", "--scene", "short-slip", "-o", tmp_path / "a.recording.h5")
    (out,) = rows(toy, "export", made["output"], "--format", "toy")
    (back,) = rows(toy, "record", "--from", out["output"], "-o", tmp_path / "b.recording.h5")
    assert made["events"] == out["events"] == back["events"]
    apart = rows(toy, "record", "--scene", "short-slip", "--count", "2", "--jobs", "2", "-o", tmp_path / "apart")
    for row in (made, *apart):
        with StageFile(Path(row["output"]), "recording") as file:
            assert file.header["made"]["evetac-toy"] == "1.0"
    with StageFile(tmp_path / "b.recording.h5", "recording") as file:
        assert file.header["parameters"]["format"] == "toy"
    assert "toy" in refusal(toy, "export", made["output"], "--format", "toi")


@pytest.mark.slow
def test_all_that_a_simulated_grasp_takes(toy: Path, made: Made, tmp_path: Path) -> None:
    """Assert that a network of a plug-in is trained, evaluated, and grasps with its scene, sensor, object, controller.

    Without the package a model of it is refused.
    """
    model, features = tmp_path / "own.model.h5", [made.beside(path, "features") for path in made.recordings]
    trained = ("--model", "mean-of-dots", "--preset", "adam", "--max-steps", "60", "--validate", features[-1])
    (row,) = rows(toy, "train", *features, *trained, "-o", model)
    assert row["model"] == "mean-of-dots"
    (row,) = rows(toy, "validate", model)
    assert row["valid"]
    scored = rows(
        toy, "evaluate", "slip", made.folder / "apart.features.h5", "--model", model, "-o", tmp_path / "r.report.h5"
    )
    assert {row["model"] for row in scored if "seeds" in row} == {"mean-of-dots"}
    named = ("--scene", "short-lift", "--object", "can", "--sensor", "noisy", "--controller", "firm", "--model", model)
    (grasped,) = rows(toy, "grasp", *named, "--lift-s", "1", "--balance-s", "0", "-o", tmp_path)
    assert grasped["output"].endswith("short-lift-can-s0-000.recording.h5")
    with StageFile(Path(grasped["output"]), "recording") as file:
        recipe = file.header["parameters"]
        assert np.isfinite(file.read("control/probability")).any()
    assert (recipe["object"], recipe["object_row"]["mass_g"]) == ("can", 350.0)
    assert (recipe["sensor"], recipe["sensor_row"]["noise_hz"]) == ("noisy", 0.3)
    assert (recipe["law"], recipe["law_method"]) == ({"approach_ticks": 2, "step_ticks": 1.0}, 1)
    with StageFile(model, "model") as file, pytest.raises(InputError, match="plug-in"):
        file.read("architecture")


@pytest.mark.slow
def test_a_network_over_images(toy: Path, made: Made, tmp_path: Path) -> None:
    """Assert that one is trained on features with events, evaluated, and grasps; without events it is refused."""
    model, recordings = tmp_path / "own.model.h5", made.recordings
    tracks = ("--tracks", made.folder, "--labels", made.folder)
    features = [Path(row["output"]) for row in rows(toy, "featurize", *recordings, *tracks, "--events", "-o", tmp_path)]
    trained = ("--model", "mean-of-picture", "--preset", "adam", "--max-steps", "20", "--validate", features[-1])
    without = [made.beside(path, "features") for path in recordings]
    assert "featurize --events" in refusal(toy, "train", *without, *trained[:-1], without[-1], "-o", model)
    (row,) = rows(toy, "train", *features, *trained, "-o", model)
    assert row["model"] == "mean-of-picture"
    assert all(row["valid"] for row in rows(toy, "validate", model, features[0]))
    named = ("--scene", "short-lift", "--object", "can", "--sensor", "noisy", "--model", model)
    (grasped,) = rows(toy, "grasp", *named, "--lift-s", "1", "--balance-s", "0", "-o", tmp_path)
    with StageFile(Path(grasped["output"]), "recording") as file:
        assert np.isfinite(file.read("control/probability")).any()


def test_doctor(toy: Path, broken: Path) -> None:
    """Assert that doctor lists every plug-in with package and version, and says of each that fails what is wrong."""
    listed = [row for row in rows(toy, "doctor") if "evetac-toy" in row["device"]]
    named = {row["check"] for row in listed}
    assert named == {plugins.Plugin(g, name, "", "", "").what for g, names in GROUPS.items() for name in names}
    assert all(row["ok"] and row["device"] == "plug-ins of evetac-toy 1.0" for row in listed)

    done = run(broken, "doctor", "--json")
    assert done.returncode == 3
    faults = {
        (row["device"].split()[2], row["check"]): row["found"]
        for row in json.loads(done.stdout)["rows"]
        if row["device"].startswith("plug-ins")
    }
    assert faults == {
        ("evetac-absent", "camera absent"): "ModuleNotFoundError: No module named 'no_such_module'",
        ("evetac-dies", "camera dies"): "OSError: no camera library on this machine",
        ("evetac-named", "scene Grand Scene"): "a name has lower-case letters, digits and -, e.g. lab-3",
        ("evetac-other", "camera other"): "json:JSONDecoder is no evetac_cli.devices.cameras.NamedCamera",
        ("evetac-other", "gripper mine"): "evetac-taken has one of this name too",
        ("evetac-taken", "camera sim"): "sim is one of evetac's own names",
        ("evetac-taken", "gripper mine"): "evetac-other has one of this name too",
    }


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--camera", "absent"), "No module named 'no_such_module'"),
        (("--camera", "dies:3"), "no camera library on this machine"),
        (("--camera", "stripy"), "dvxplorer[:SERIAL], dv[:SERIAL], replay:FILE, absent, dies or other"),
        (("--camera", "virtual", "--gripper", "mine"), "evetac-taken has one of this name too"),
    ],
)
def test_a_broken_one_is_refused_where_it_is_asked_for(broken: Path, flags: tuple[str, ...], said: str) -> None:
    """Assert that a command which asks for a plug-in that cannot be used says why, with exit code 2."""
    assert said in refusal(broken, "record", *flags, "--seconds", "0.1")


class _Counted:
    """Stands in for metadata.entry_points, and remembers the groups that were asked for."""

    def __init__(self) -> None:
        self.groups: list[str] = []

    def __call__(self, group: str) -> tuple[Any, ...]:
        self.groups.append(group)
        return ()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The groups of entry points that are read from now on."""
    counted = _Counted()
    plugins.installed.cache_clear()
    monkeypatch.setattr(metadata, "entry_points", counted)
    yield counted.groups
    plugins.installed.cache_clear()


def quietly(*arguments: str) -> None:
    """Run a command here; it ends well."""
    with pytest.raises(SystemExit) as ended:
        main.app(list(arguments))
    assert ended.value.code in (0, None)


@pytest.mark.parametrize(
    "command",
    [
        lambda made: quietly("--help"),
        lambda made: quietly("record", "--help"),
        lambda made: quietly("validate", str(made.model), str(made.recordings[0]), str(made.grasp)),
        lambda made: quietly("record", "--camera", "virtual", "--sensor", "soft-gel", "--dry-run"),
    ],
    ids=["--help", "record --help", "validate", "record"],
)
def test_entry_points_are_not_read_for_names_of_ours(
    command: Callable[[Made], None], made: Made, asked: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that help, info and commands with names of ours alone read no entry points."""
    command(made)
    assert capsys.readouterr().out
    assert asked == []


# --- plug-ins of a package that is not installed ----------------------------------------------------------------------


class OneCamera(NamedCamera):
    """A camera that cannot be understood."""

    name = "one"

    @classmethod
    def parse(cls, text: str) -> Any:
        """Fail, as code of anybody's may."""
        return 1 // len(text)


@dataclass(frozen=True)
class Unnumbered(PluginLaw):
    """A law that does not say its method."""


@dataclass(frozen=True)
class Numbered(PluginLaw):
    """A law that does."""

    method = 3


def test_a_class_for_devices_and_an_instance_for_all_else(add: Add) -> None:
    """Assert that the one in the place of the other is refused in words."""
    add(plugins.CAMERAS, one=OneCamera, two=OneCamera())
    add(plugins.GRIPPERS, three=grippers.NoGripper())
    add(plugins.CONTROLLERS, four=Numbered)
    add(plugins.EXPORTERS, five=exports.ExportFormat)
    assert plugins.find(plugins.CAMERAS, "one", NamedCamera) is OneCamera
    with pytest.raises(InputError, match="is an instance"):
        cameras.parse("two")
    with pytest.raises(InputError, match="is an instance"):
        grippers.parse("three")
    with pytest.raises(InputError, match="is a class"):
        plugins.find(plugins.CONTROLLERS, "four", PluginLaw)
    with pytest.raises(InputError, match="is a class"):
        exports.named_format("five")


def test_an_importer_that_cannot_be_used_stops_no_other(add: Add, tmp_path: Path) -> None:
    """Assert that it is left out, and that a match counts as use."""
    other = imports.FORMATS["text"]
    add(plugins.IMPORTERS, "odd", b=ImportFormat, c="lab events")
    add(plugins.IMPORTERS, "fine", f=ImportFormat((b"\x01lab events",), other.read))
    (path := tmp_path / "a.lab").write_bytes(b"\x02none\n")
    with pytest.raises(InputError) as refused:
        read_events(path)
    assert "begins with" in str(refused.value)
    assert plugins.used() == {}
    path.write_bytes(b"\x01lab events\n")
    assert imports._format(path).begins == (b"\x01lab events",)
    assert plugins.used() == {"fine": "2.0"}


def test_a_law_says_its_method(add: Add) -> None:
    """Assert that a law without one is refused, and that one has it in its recipe, and no gain."""
    add(plugins.CONTROLLERS, bare=Unnumbered(), full=Numbered())
    with pytest.raises(InputError, match="has no `method`"):
        settings._law("bare", 1.0, MARGIN)
    law = settings._law("full", 1.0, MARGIN)
    trial: Any = SimpleNamespace(plan=None, number=0)
    of_law = settings.GraspSettings("full", 1.0, law, 500.0, 0, 1.0, 1.0, None)
    assert of_law.parameters(trial)["law_method"] == 3
    ours = settings.GraspSettings("none", 1.0, settings._law("none", 1.0, MARGIN), 500.0, 0, 1.0, 1.0, None)
    assert "law_method" not in ours.parameters(trial)
    with pytest.raises(InputError, match="paper and paper-reset") as refused:
        settings._law("full", 2.0, MARGIN)
    assert "full with gain 2" in str(refused.value)


def test_a_package_counts_as_used_where_it_has_a_part(add: Add) -> None:
    """Assert that asking, loading and doctor do not count, and that no package takes the place of what is ours."""
    add(plugins.CAMERAS, "numpy", one=OneCamera)
    add(plugins.CONTROLLERS, "evetac", full=Numbered())
    add(plugins.GRIPPERS, "lab", none_such=grippers.NoGripper)
    assert [row["ok"] for row in doctor.plugin_rows()] == [True, False, True]
    assert plugins.by_name(plugins.CAMERAS, "one") is not None
    assert plugins.used() == {}
    before = time_host_versions()
    plugins.find(plugins.CAMERAS, "one", NamedCamera)
    plugins.find(plugins.CONTROLLERS, "full", PluginLaw)
    assert plugins.used() == {"numpy": "2.0", "evetac": "2.0"}
    assert {**time_host_versions(), "at": ""} == {**before, "at": ""}


def test_an_internal_error_names_the_plug_ins(add: Add, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that an unexpected error names the packages of plug-ins that are used, as it may be theirs."""
    exit_codes._say_internal_error(ZeroDivisionError("x"), verbose=True)
    assert "plug-in" not in capsys.readouterr().err
    add(plugins.CAMERAS, one=OneCamera)
    plugins.find(plugins.CAMERAS, "one", NamedCamera)
    exit_codes._say_internal_error(ZeroDivisionError("x"), verbose=True)
    said = capsys.readouterr().err
    assert "ZeroDivisionError" in said and "or of a plug-in of lab 2.0" in said


def test_a_worker_without_the_package(add: Add, tmp_path: Path) -> None:
    """Assert that a worker of a cluster is refused in words where a plug-in is missing or of another version."""
    (tmp_path / "sign").touch()
    add(plugins.CAMERAS, one=OneCamera)
    plugins.find(plugins.CAMERAS, "one", NamedCamera)
    (part,) = plugins.parts()

    def answer(part: plugins.Plugin) -> str:
        version = dask_engine.__version__
        command = dask_engine.ClusterCommand("record", None, False, version, tmp_path, tmp_path / "sign", (part,))
        return dask_engine.check_worker(pickle.loads(pickle.dumps(command)))

    assert answer(part) == ""
    assert answer(part._replace(version="1.9")) == "has lab 2.0, but the command has lab 1.9"
    del sys.modules["lab_parts"].one  # type: ignore[attr-defined]
    assert "cannot use the plug-in camera one of lab: AttributeError" in answer(part)
    assert answer(part._replace(name="two")) == "lacks the package lab with the plug-in camera two"


def foreign(*columns: Any) -> EventSource:
    """A file of events in a frame of 64 x 48 px."""
    return EventSource("odd", (64, 48), [EventColumns(*columns, place=str)])


ONES = np.ones(3, np.int64)


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (replace(foreign(ONES, ONES, ONES, ONES), frame_px=(0, 48)), "impossible frame size"),
        (foreign(ONES, ONES, ONES, 2 * ONES), "unknown polarity"),
    ],
)
def test_what_an_importer_returns(add: Add, tmp_path: Path, read: Any, said: str) -> None:
    """Assert that events of an importer that are none are refused in words."""
    add(plugins.IMPORTERS, odd=ImportFormat((b"\x01odd",), lambda path, frame_px: read))
    (path := tmp_path / "a.odd").write_bytes(b"\x01odd\n")
    with pytest.raises(InputError, match=said):
        read_events(path)


def test_what_a_plug_in_prints_is_not_json(add: Add, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Assert that --json prints one object on stdout, whatever a plug-in, its libraries or processes print."""

    class Loud(OneCamera):
        @classmethod
        def parse(cls, text: str) -> Any:
            print("hello from Python")
            os.write(1, b"hello from C\n")
            subprocess.run(["echo", "hello from a process"], check=True)
            raise InputError("not this camera")

    add(plugins.CAMERAS, one=Loud)
    with pytest.raises(SystemExit):
        main.app(["record", "--camera", "one", "--seconds", "1", "-o", str(tmp_path / "a.recording.h5"), "--json"])
    written = capfd.readouterr()
    assert json.loads(written.out)["error"]["message"] == "not this camera"
    assert written.err.count("hello from") == 3


def test_a_network_whose_forms_differ(add: Add, made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that `train` refuses a network with a maximum in torch and a mean in ONNX, and writes nothing."""
    spec = importlib.util.spec_from_file_location("toy_network", TOY / "evetac_toy" / "network.py")
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(module := importlib.util.module_from_spec(spec))

    class MaxOfDots(module.MeanOfDots):  # type: ignore[misc, name-defined]
        def hidden(self, modules: Any, inputs: Any) -> Any:
            return modules["code"](inputs).relu().amax(1)

    views = module.MEAN_OF_DOTS.views
    add(plugins.NETWORKS, odd=MaxOfDots("odd", views), fine=module.MeanOfDots("fine", views))
    features = [str(made.beside(path, "features")) for path in made.recordings]

    def train_with(name: str) -> tuple[Any, str]:
        flags = ("--preset", "adam", "--max-steps", "20", "--validate", features[-1])
        with pytest.raises(SystemExit) as ended:
            main.app(["train", *features, "--model", name, *flags, "-o", str(tmp_path / f"{name}.model.h5")])
        return ended.value.code, capsys.readouterr().err

    code, said = train_with("odd")
    assert code == 2
    assert "the plug-in network odd cannot be used" in said and "lab" in said
    assert "torch and ONNX return probabilities up to" in said
    assert not list(tmp_path.glob("*.h5"))
    assert train_with("fine")[0] in (0, None)
    assert (tmp_path / "fine.model.h5").is_file()
