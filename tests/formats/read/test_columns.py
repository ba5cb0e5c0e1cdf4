"""Times of columns: a guess of their unit is tested for sense, and coarse numbers are noticed."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.formats.imports import read_events
from tests.importing import FRAME, refusal

RNG = np.random.default_rng(7)
COUNT = 20_000
# Two seconds of a camera that makes 10,000 events per second: 0.03 per second and pixel.
T_US = np.sort(RNG.integers(0, 2_000_000, COUNT))
X, Y, P = (RNG.integers(0, most, COUNT) for most in (*FRAME, 2))


def npz(path: Path, t: Any, **columns: Any) -> Path:
    count = len(t)
    np.savez(path / "a.npz", **({"t": t, "x": X[:count], "y": Y[:count], "p": P[:count]} | columns))
    return path / "a.npz"


def rpg(path: Path, t: Any) -> Path:
    with h5py.File(path / "a.h5", "w") as file:
        for name, column in zip("txyp", (t, X[: len(t)], Y[: len(t)], P[: len(t)]), strict=True):
            file[f"events/{name}s"] = column
    return path / "a.h5"


def text(path: Path, t: Any) -> Path:
    table = zip(t.tolist(), X.tolist(), Y.tolist(), P.tolist(), strict=False)
    (path / "a.txt").write_text("".join(" ".join(map(repr, row)) + "\n" for row in table))
    return path / "a.txt"


WRITERS = {"npz": npz, "rpg": rpg, "text": text}
# Times of one recording in a unit that nothing names, and what they would be in microseconds.
DOUBTFUL = {
    "ns": (T_US * 1000, "in nanoseconds: 2 s", "ns"),
    "ns of a clock of its own": (np.sort(RNG.integers(0, 2_000_000_000, COUNT)), "in nanoseconds: 2 s", "ns"),
    "ns of a busy camera": (np.sort(RNG.integers(0, 200_000_000, COUNT)), "in nanoseconds: 0.2 s", "ns"),
    "ms": (T_US // 1000, "in milliseconds: 2 s", "ms"),
    "ms of a short recording": (np.sort(RNG.integers(0, 500, COUNT)), "in milliseconds: 0.499 s", "ms"),
}


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("name", DOUBTFUL)
def test_a_unit_that_makes_no_sense_is_refused(tmp_path: Path, writer: str, name: str) -> None:
    """Assert that whole times in other units are not taken for us, and the flag that is named helps."""
    t, reading, unit = DOUBTFUL[name]
    path = WRITERS[writer](tmp_path, t)
    words = refusal(path, frame_px=FRAME)
    assert "the unit of time" in words and reading in words and "--time-unit" in words
    imported = read_events(path, frame_px=FRAME, time_unit=unit)
    expected = (t - t[0]) * 1000 if unit == "ms" else t // 1000 - t[0] // 1000
    assert imported.events.t.tolist() == expected.tolist()
    assert not any(note.startswith("assumed: time") for note in imported.notes)


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize(
    "t",
    [
        pytest.param(T_US, id="us"),
        pytest.param(T_US / 1e6, id="s"),
        pytest.param(np.sort(RNG.integers(0, 50_000, COUNT)), id="50 ms of a busy camera"),
        pytest.param(np.arange(200) * 500_000, id="a few events in 100 s"),
        pytest.param(np.arange(COUNT) // 100 * 33_000, id="frames of a simulator"),
        pytest.param(T_US + 1_700_000_000_000_000, id="us since 1970"),
    ],
)
def test_a_unit_that_makes_sense_is_taken(tmp_path: Path, writer: str, t: Any) -> None:
    """Assert that usual recordings need no flag, and that what was assumed is said."""
    imported = read_events(WRITERS[writer](tmp_path, t), frame_px=FRAME)
    us = np.rint(t * 1e6).astype(np.int64) if t.dtype.kind == "f" else t
    assert imported.events.t.tolist() == (us - us[0]).tolist()
    assert any(note.startswith("assumed: ") for note in imported.notes)


@pytest.mark.parametrize("writer", ["npz", "rpg"])
@pytest.mark.parametrize(
    ("t", "words"),
    [
        ((T_US / 1e6 + 1.6e9).astype("f4"), "in steps of 128"),
        ((T_US / 1e6).astype("f2"), "times are too coarse"),
        ((T_US / 1e6 + 100_000.5).astype("f4"), "times are too coarse"),
        ((T_US * 100).astype("f4"), "in steps of 16"),
    ],
)
def test_numbers_too_coarse_for_times_are_refused(tmp_path: Path, writer: str, t: Any, words: str) -> None:
    """Assert that a type whose steps are larger than a slice, or hide the unit, is refused."""
    assert words in refusal(WRITERS[writer](tmp_path, t), frame_px=FRAME)


def test_coarse_whole_times_are_taken_with_their_unit(tmp_path: Path) -> None:
    """Assert that steps between a microsecond and a slice are allowed by the flag."""
    t = (np.arange(COUNT) * 10_000).astype("f4")
    imported = read_events(npz(tmp_path, t), frame_px=FRAME, time_unit="us")
    assert imported.events.t.tolist() == (np.arange(COUNT) * 10_000).astype("f4").astype(np.int64).tolist()


def test_an_impossible_rate_is_refused(tmp_path: Path) -> None:
    """Assert that 10^9 events per second are no recording of one camera, and that a layout's own unit is asked too."""
    t = np.arange(COUNT) // 1000
    assert "implausible" in refusal(npz(tmp_path, t), frame_px=FRAME)
    with h5py.File(tmp_path / "dsec.h5", "w") as file:
        for name, column in zip("txyp", (T_US * 1000, X, Y, P), strict=True):
            file[f"events/{name}"] = column
    assert "in nanoseconds: 2 s" in refusal(tmp_path / "dsec.h5", frame_px=FRAME)
    assert read_events(tmp_path / "dsec.h5", frame_px=FRAME, time_unit="ns").slices == 2000


@pytest.mark.parametrize("values", [(255, 1), (65535, 1), (2**32 - 1, 1), (2**64 - 1, 1)])
@pytest.mark.parametrize("kind", ["u", "f", "table"])
def test_minus_one_without_a_sign(tmp_path: Path, values: tuple[int, int], kind: str) -> None:
    """Assert that -1 in a column without signs is darker, in any type that held it, and that it is said."""
    p = np.where(P > 0, np.uint64(values[1]), np.uint64(values[0]))
    if kind == "f" and values[0] < 2**53:
        path = npz(tmp_path, T_US, p=p.astype(float))
    elif kind == "table" and values[0] < 2**63:
        np.save(tmp_path / "a.npy", np.stack([T_US, X, Y, p.astype(np.int64)], axis=1))
        path = tmp_path / "a.npy"
    else:
        path = npz(tmp_path, T_US, p=p)
    imported = read_events(path, frame_px=FRAME)
    assert imported.events.p.tolist() == P.tolist()
    assert f"polarity {values[0]} was read as -1 (darker)" in imported.notes


@pytest.mark.parametrize(
    ("size", "sensor"), [((480, 640), "640x480"), ((260, 346), "346x260"), ((180, 240), "240x180")]
)
def test_exchanged_axes_are_noticed(tmp_path: Path, size: tuple[int, int], sensor: str) -> None:
    """Assert that a frame that stands on its side is said to fit a smaller sensor, and naming the columns mends it."""
    x, y = (RNG.integers(0, most, COUNT) for most in size)
    x[0], y[0] = size[0] - 1, size[1] - 1
    np.save(tmp_path / "a.npy", np.stack([T_US, x, y, P], axis=1))
    imported = read_events(tmp_path / "a.npy")
    assert any(f"would fit {sensor}" in note for note in imported.notes)
    mended = read_events(tmp_path / "a.npy", columns="t y x p")
    assert "{}x{}".format(*mended.frame_px) == sensor
    assert mended.events.x.tolist() == y.tolist()
    assert not any("exchanged" in note for note in mended.notes)
    assert "once each" in refusal(tmp_path / "a.npy", columns="t y x")
