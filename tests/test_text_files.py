"""Text files from elsewhere, at each place that reads one: refused in words, at once, whatever they are."""

import json
import math
import os
import pickle
import resource
import signal
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from evetac_cli import text_files
from evetac_cli.cli import config
from evetac_cli.commands.calibrate import Calibrate
from evetac_cli.commands.label import Label
from evetac_cli.errors import InputError
from evetac_cli.formats.calibration_files import read_pickle
from evetac_cli.formats.imports import read_events
from evetac_cli.sim.setup import scene_file
from evetac_cli.stages import calibrate
from evetac_cli.store.calibration import read_calibration

FRAME_PX = (640, 480)
READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "--config": ("a.toml", lambda path: config.resolve(Label, "label", {}, path)),
    "--scene": ("a.toml", lambda path: scene_file.load(str(path))),
    "--calibration": ("a.json", read_calibration),
    "calibrate --import": ("a.pkl", read_pickle),
    "record --from": ("a.txt", lambda path: read_events(path, frame_px=FRAME_PX)),
}
MOST_ECHOED = 2_000  # characters of an error, its file's name included


MORE_BYTES = 2 << 30  # of memory than before the test


@pytest.fixture(autouse=True)
def _an_end() -> Iterator[None]:
    """What reads for ever is broken off, by time or memory: far beyond what any refusal takes."""

    def broken_off(number: int, frame: FrameType | None) -> None:
        pytest.fail("it does not end")

    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + MORE_BYTES, limits[1]))
    before = signal.signal(signal.SIGALRM, broken_off)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
    resource.setrlimit(resource.RLIMIT_AS, limits)


def refused(read: Callable[[Path], Any], path: Path) -> str:
    """The words in which a file is refused."""
    with pytest.raises(InputError) as caught:
        read(path)
    assert len(str(caught.value)) < MOST_ECHOED
    assert str(path) in str(caught.value)
    return str(caught.value)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def missing(path: Path) -> None:
    path.symlink_to("nowhere")


@pytest.mark.parametrize("make", [pipe, Path.mkdir, missing])
@pytest.mark.parametrize("reader", READERS)
def test_only_regular_files_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str, make: Callable[[Path], None]
) -> None:
    """Assert that a pipe, socket, device, folder or link to nothing is refused in words, without waiting for it."""
    monkeypatch.chdir(tmp_path)
    name, read = READERS[reader]
    make(tmp_path / name)
    refused(read, tmp_path / name)


@pytest.mark.parametrize("reader", [reader for reader in READERS if reader != "record --from"])
def test_a_large_file_is_not_read(tmp_path: Path, reader: str) -> None:
    """Assert that a file of 16 GB, all holes, is refused for its size, and not loaded."""
    name, read = READERS[reader]
    path = tmp_path / name
    with path.open("wb") as file:
        file.truncate(1 << 34)
    assert "bytes" in refused(read, path)


LONG_NUMBER = "9" * 100_000
TOML = {
    "dots": "label." + "a." * 100_000 + "a = 1",
    "dots between quoted parts": "label." + '"a b".' * 40_000 + "a = 1",
    "nested lists": "label = " + "[" * 100_000,
    "100,000 keys": "".join(f"k{number} = 1\n" for number in range(100_000)),
    "a whole number of 100,000 digits": f"label = {LONG_NUMBER}",
    "a whole number of 65 bits": "[label]\nconfirm_ms = " + str(1 << 64),
    "no text": "\xff".encode("latin1"),
}


@pytest.mark.parametrize("text", TOML.values(), ids=TOML)
@pytest.mark.parametrize("reader", ["--config", "--scene"])
def test_hostile_toml(tmp_path: Path, reader: str, text: str | bytes) -> None:
    """Assert that TOML beyond the limits is refused at once, and little of it is repeated."""
    path = tmp_path / "a.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(READERS[reader][1], path)


JSON = {
    "nested lists": "[" * 100_000,
    "a whole number of 100,000 digits": json.dumps({"frame_px": [640, 480], "radius_px": 0}).replace("0}", LONG_NUMBER),
    "a frame of 100,000 digits": f'{{"frame_px": [{LONG_NUMBER}, 480]}}',
    "no text": "\xff".encode("latin1"),
}


@pytest.mark.parametrize("text", JSON.values(), ids=JSON)
def test_hostile_json(tmp_path: Path, text: str | bytes) -> None:
    """Assert that JSON beyond the limits is refused at once, and little of it is repeated."""
    path = tmp_path / "a.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(read_calibration, path)


GRID = np.stack(np.meshgrid(50.0 + 60 * np.arange(8), 40.0 + 60 * np.arange(7)), axis=2).reshape(-1, 2)


@pytest.mark.parametrize("flags", [{}, {"irregular": True}], ids=["", "no grid"])
def test_a_flipped_centre_writes_no_calibration(tmp_path: Path, flags: dict[str, Any]) -> None:
    """Assert that no bit of a centre makes a calibration that cannot be read: each is refused, or read back."""
    source, out = tmp_path / "grid.pkl", tmp_path / "o.json"
    chosen = Calibrate(source=source, gel=None, **flags)
    (job,) = calibrate.jobs([], chosen, out)
    for bit in (0, 17, 34, *range(46, 64)):  # sign, exponent and the largest digits, and a few others
        flipped = GRID.copy()
        flipped[:1, :1].view(np.uint64)[...] ^= np.uint64(1 << bit)
        source.write_bytes(pickle.dumps((flipped, np.full((len(GRID), 1), 20.0))))
        out.unlink(missing_ok=True)
        try:
            calibrate.run(job, chosen)
        except InputError:
            assert not out.exists()
        else:
            read_calibration(out)


@pytest.mark.parametrize("value", [{"a": [1, 2.5, None, True, "x"]}, 2**128, -(2**128), "", [], 1e300])
def test_json_is_read(value: object) -> None:
    """Assert that ordinary values come back, whole numbers of a seed's length among them."""
    assert text_files.parse_json(json.dumps(value), whole_bits=text_files.SEED_BITS + 1) == value


@pytest.mark.parametrize("text", ["", "{", "NaN", "[Infinity]", str(2**64), "9" * 5000, "[1" + "0" * 100_000 + "]"])
def test_what_is_no_json_is_refused(text: str) -> None:
    """Assert that broken text, numbers that JSON does not have, and those of thousands of digits are refused."""
    with pytest.raises(ValueError):
        text_files.parse_json(text)


def test_toml_that_is_written_is_read() -> None:
    """Assert that texts, numbers, truth values, lists and tables in tables come back as they were."""
    table = {
        "text": 'a "quoted" \\ line\nand \u00b5 \U0001f590 \x7f\t',
        "inner": {"flag": True, "deeper": {"list": [[1, 2.5], []], "deepest": {"x": -1e-7}}},
        "flags": [False, True],
        "wide": [math.inf, -math.inf],
        "empty": {},
    }
    assert tomllib.loads(text_files.as_toml(table)) == table
    assert math.isnan(tomllib.loads(text_files.as_toml({"x": math.nan}))["x"])
    assert text_files.as_toml({}) == ""
