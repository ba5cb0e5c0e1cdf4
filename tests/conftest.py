"""Files of every kind, made by the real stages from the smallest scene and shared by the tests of a session."""

import fcntl
import gc
import os
import shutil
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dynamixel_sdk import INST_REBOOT
from hypothesis import HealthCheck, settings

from evetac_cli import plugins
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.label import Label
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.commands.train import Train
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.devices import cameras
from evetac_cli.devices.cameras import prepared_words
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import Bus
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.devices.virtual.word_sources import PreparedWords
from evetac_cli.realtime.shared_time import SharedTime
from evetac_cli.resources import SCENES
from evetac_cli.stages import featurize, label, track, train
from evetac_cli.stages.force import train_force
from evetac_cli.text_files import as_toml
from evetac_cli.trials import grasp, record
from tests.browser import Browser
from tests.small_files import recording_of

# No test depends on the speed of the machine.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# A background program of a script starts with Ctrl-C ignored, and one under nohup with SIGHUP ignored. The processes
# that they start inherit this.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Files made by others, which are not in the repository. EVETAC_OUTSIDE_FILES names another folder.
OUTSIDE = Path(os.environ.get("EVETAC_OUTSIDE_FILES") or Path(__file__).resolve().parents[2] / "shared" / "data")

# The slip scene, but with slip within a second and a coarse gel.
SHORT = {
    "rest_s": 0.05,
    "load_s": 0.05,
    "hold_s": 0.05,
    "after_lost_s": 0.02,
    "longest_s": 4.0,
}


@pytest.fixture
def words_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the prepared words of cameras opened by name wait for the machine, so that their counts are exact."""

    def waiting(events_s: float, seeds: np.random.SeedSequence) -> PreparedWords:
        return prepared_words(events_s, seeds, SharedTime())

    monkeypatch.setattr(cameras, "prepared_words", waiting)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options for real devices to test the device contract on, named as on evetac's command line."""
    parser.addoption("--camera", default=None, help="a camera on this machine, such as dvxplorer")
    parser.addoption("--gripper", default=None, help="a gripper on this machine, such as /dev/ttyUSB0; it will move")


def pytest_collection() -> None:
    """Look for no garbage among the modules and tests, a million objects that live to the end."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Leave these out of the searches during the tests, each of which would take half a second."""
    gc.freeze()
    gc.enable()


def pytest_unconfigure() -> None:
    """Let libraries see at exit that nothing is left of them."""
    gc.unfreeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that want files from outside the repository, so that CI can run them where there are none."""
    for item in items:
        if "outside_file" in getattr(item, "fixturenames", ()):
            item.add_marker("outside")


@pytest.fixture(scope="session")
def outside_file() -> Callable[[str], Path]:
    """Return the path of a file from outside the repository by its name; without it, the test is skipped."""

    def path_of(name: str) -> Path:
        if not (OUTSIDE / name).is_file():
            pytest.skip(f"{name}, from outside the repository, is not there")
        return OUTSIDE / name

    return path_of


@dataclass
class Made:
    """One trial and the files computed from it, a model, and a grasp."""

    folder: Path
    scene: Path
    recordings: list[Path] = field(default_factory=list)

    def beside(self, recording: Path, kind: str) -> Path:
        return recording.with_name(recording.name.replace(".recording.", f".{kind}."))

    @property
    def model(self) -> Path:
        return self.folder / "hist10.model.h5"

    @property
    def force_model(self) -> Path:
        return self.folder / "dots.force-model.h5"

    @property
    def grasp(self) -> Path:
        return self.folder / "grasp.recording.h5"


@pytest.fixture(scope="session")
def short_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The slip scene, shortened."""
    scene = tomllib.loads((SCENES / "slip.toml").read_text())
    scene["name"] = "short"
    scene["time"] |= SHORT
    scene["solver"] = {"node_pitch_mm": 1.667}
    scene["gripper"] = {"start_factor": [1.2, 1.25], "friction_factor": [0.1, 0.12]}
    path = tmp_path_factory.mktemp("scene") / "short.toml"
    path.write_text(as_toml(scene))
    return path


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory, worker_id: str, short_scene: Path) -> Made:
    """Recordings with labels, tracks and features, a model trained on them, and a grasp with that model.

    The first process that wants the files makes them for all, so tests may only read or copy them.
    """
    own = tmp_path_factory.getbasetemp()
    folder = (own if worker_id == "master" else own.parent) / "made"
    made = Made(folder, short_scene)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.grasp.exists():
            _make(made)
    made.recordings += sorted(folder.glob("short-*.recording.h5"))
    return made


def _make(made: Made) -> None:
    """Make the files, the grasp last."""
    recipe = Record(scene=str(made.scene), objects="8", count=3)
    jobs = record.jobs([], recipe, made.folder)
    recordings = [job.output for job in jobs]
    for job in jobs:
        record.run(job, recipe)
    # A trial that is not used for training; its name distinguishes it from the others.
    alone = Record(scene=str(made.scene), objects="8", seed=77)
    (job,) = record.jobs([], alone, made.folder / "apart.recording.h5")
    record.run(job, alone)
    for path in (*recordings, job.output):
        for stage, chosen in (
            (track, Track()),
            (label, Label(after_ms=25)),
            (featurize, Featurize()),
        ):
            (job,) = stage.jobs([path], chosen, None)
            stage.run(job, chosen)
    features = [made.beside(path, "features") for path in recordings]
    training = Train(epochs=30, max_steps=120, preset="adam", validate=str(features[-1]))
    (job,) = train.jobs(features, training, made.model)
    train.run(job, training)
    fitting = TrainForce(samples=10, epochs=2)
    (job,) = train_force.jobs([made.beside(path, "tracks") for path in recordings], fitting, made.force_model)
    train_force.run(job, fitting)
    grasping = Grasp(controller="paper", model=made.model, lift_s=1.0, balance_s=0.2, node_pitch_mm=1.45)
    (job,) = grasp.jobs([], grasping, made.grasp)
    grasp.run(job, grasping)


@pytest.fixture(scope="session")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write ten minutes of a few events, long enough to be still playing when a test interrupts it."""
    return recording_of(tmp_path_factory.mktemp("long") / "long.recording.h5", [2] * 600_000)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Start a headless Chromium for tests of pages."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
    if program is None:
        pytest.skip("no Chromium is installed: the page is not tested in a browser")
    chromium = Browser(program, tmp_path_factory.mktemp("chromium"))
    yield chromium
    chromium.close()


# A gripper for testing the driver.

SLOW = RhP12RnSettings(answer_ms=2000, watchdog_ms=2540)  # nothing is lost on a busy machine


@pytest.fixture(scope="module")
def gripper() -> Iterator[VirtualGripper]:
    """Start the virtual gripper of a test module."""
    with VirtualGripper() as made:
        yield made


@pytest.fixture
def fresh(gripper: VirtualGripper) -> VirtualGripper:
    """Return the module's gripper in the state after a power cycle."""
    reboot(gripper)
    return gripper


def reboot(gripper: VirtualGripper) -> None:
    with Bus(gripper.port, 2_000_000, answer_ms=SLOW.answer_ms) as bus:
        bus.tolerant = True
        bus._transact(INST_REBOOT, b"", 0, "reboot")


def is_off(gripper: VirtualGripper) -> bool:
    return gripper.read_register("Torque Enable") == 0 and gripper.read_register("Goal Current") == 0


Add = Callable[..., None]


@pytest.fixture
def add(monkeypatch: pytest.MonkeyPatch) -> Iterator[Add]:
    """Add plug-ins to a group, by name, as of a package `lab` (or another) whose module they are in."""
    entries: list[metadata.EntryPoint] = []
    module = ModuleType("lab_parts")

    def to(group: str, package: str = "lab", **parts: Any) -> None:
        vars(module).update(parts)
        about = SimpleNamespace(name=package, version="2.0")
        for name in parts:
            entry = metadata.EntryPoint(name, f"lab_parts:{name}", group)
            entries.append(entry._for(about))  # type: ignore[attr-defined]
        plugins.installed.cache_clear()

    plugins.installed.cache_clear()
    monkeypatch.setitem(sys.modules, "lab_parts", module)
    monkeypatch.setattr(plugins, "_used", {})
    others = metadata.entry_points
    monkeypatch.setattr(
        metadata,
        "entry_points",
        lambda **named: (
            [entry for entry in entries if entry.group == named["group"]]
            if named.get("group", "").startswith("evetac.")
            else others(**named)  # such as numba's
        ),
    )
    yield to
    plugins.installed.cache_clear()
