"""Tables of other programs: what a small Parquet file may unpack to is bounded, and only what is wanted is read."""

import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.formats.read import read_table
from evetac_cli.resources import PACKAGE

pa = pytest.importorskip("pyarrow")
import pyarrow.parquet as pq  # noqa: E402  (not installed everywhere)

ROWS = 5000
RNG = np.random.default_rng(3)
X = RNG.normal(size=ROWS)


def written(path: Path, columns: dict[str, Any], **options: Any) -> Path:
    pq.write_table(pa.table(columns), path, **options)
    return path


def read(path: Path) -> Any:
    return read_table.read_table(path, None)[0]


def same_rows(count: int) -> dict[str, Any]:
    return {"t_ms": pa.array(np.zeros(count, np.int64)), "x": pa.array(np.zeros(count))}


def texts(count: int, size: int) -> Any:
    """As many rows of one long text, which the file holds once."""
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, np.int32)), pa.array(["x" * size]))


def test_a_small_file_does_not_become_a_large_one(tmp_path: Path) -> None:
    """Assert that rows by runs are refused by what they would take, before one is read; a plain table is not."""
    path = written(tmp_path / "a.parquet", same_rows(8_000_000), compression="zstd")
    assert path.stat().st_size < 1e6
    with pytest.raises(InputError, match=r"unpack to too much(.|\n)*128 MB"):
        read(path)
    columns = {"t_ms": np.arange(ROWS), "x": X, **{f"c{at}": np.zeros(ROWS) for at in range(100)}}
    assert len(read(written(tmp_path / "b.parquet", columns)).columns) == 101


def test_a_text_is_not_read(tmp_path: Path) -> None:
    """Assert that a column that is left out costs neither memory nor time: here 20 GB of one text."""
    columns = {"t_ms": np.arange(2000), "s": texts(2000, 10_000_000), "x": np.arange(2000.0)}
    path = written(tmp_path / "a.parquet", columns, compression="zstd", store_schema=False)
    assert path.stat().st_size < 1e5
    program = "import sys; from pathlib import Path; from evetac_cli.formats.read.read_table import read_table\n" \
              "print(len(read_table(Path(sys.argv[1]), None)[0].t_us))"  # fmt: skip

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))

    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, preexec_fn=limit, env={"PYTHONPATH": str(PACKAGE.parent)}
    )
    assert done.stdout.strip() == "2000", done.stderr[-500:]


def test_a_text_for_a_time_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """Assert that times of text, lists and tables are no numbers, in words, and that none of them is unpacked."""
    for number, column in enumerate((texts(2000, 10_000_000), [[1]] * 2000, [{"a": 1}] * 2000)):
        path = written(tmp_path / f"{number}.parquet", {"t_ms": column, "x": np.arange(2000.0)}, store_schema=False)
        with pytest.raises(InputError, match="the times are not numbers"):
            read(path)


def test_a_footer_that_pyarrow_ends_the_program_for(tmp_path: Path) -> None:
    """Assert that a footer with a byte changed is refused or read, in a process that goes on, wherever the byte is."""
    path = written(tmp_path / "a.parquet", {"t_ms": np.arange(60), "x": np.zeros(60)})
    content = path.read_bytes()
    size = int.from_bytes(content[-8:-4], "little")
    program = (
        "import sys; from pathlib import Path; from evetac_cli.errors import InputError\n"
        "from evetac_cli.formats.read.read_table import read_table\n"
        "content, size = Path(sys.argv[1]).read_bytes(), int(sys.argv[2])\n"
        "for at in range(len(content) - size - 8, len(content) - 8, 3):\n"
        "    damaged = bytearray(content); damaged[at] ^= 1\n"
        "    Path(sys.argv[3]).write_bytes(damaged)\n"
        "    try: read_table(Path(sys.argv[3]), None)\n"
        "    except InputError: pass\n"
    )
    command = [sys.executable, "-c", program, str(path), str(size), str(tmp_path / "b.parquet")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={"PYTHONPATH": str(PACKAGE.parent)})
    assert (done.returncode, done.stderr) == (0, "")


def test_columns_keep_their_names_and_order(tmp_path: Path) -> None:
    """Assert that lists, tables, texts and names with a point beside them do not shift the numbers."""
    arrays = [
        pa.array([{"a": at, "b": {"c": at}} for at in range(5)]),
        pa.array([float(at) for at in range(5)]),
        pa.array([[at, at] for at in range(5)]),
        pa.array(range(5)),
        pa.array(["text"] * 5),
        pa.array([10.0 * at for at in range(5)]),
        pa.array([at % 2 == 0 for at in range(5)]),
    ]
    names = ["struct", "x", "list", "t_us", "words", "list.x", "flag"]
    pq.write_table(pa.Table.from_arrays(arrays, names=names), tmp_path / "a.parquet")
    stream, notes = read_table.read_table(tmp_path / "a.parquet", None)
    assert stream.t_us.tolist() == [0, 1, 2, 3, 4]
    assert {name: values.tolist() for name, values in stream.columns.items()} == {
        "x": [0.0, 1.0, 2.0, 3.0, 4.0],
        "list_0": [0.0, 1.0, 2.0, 3.0, 4.0],
        "list_1": [0.0, 1.0, 2.0, 3.0, 4.0],
        "list.x": [0.0, 10.0, 20.0, 30.0, 40.0],
        "flag": [1.0, 0.0, 1.0, 0.0, 1.0],
    }
    assert notes == ["left out: columns struct, words, which are not numeric"]


def test_times_that_64_bits_do_not_hold(tmp_path: Path) -> None:
    """Assert that times are refused that would come out as others, of few microseconds, once they are numbers of us."""
    least = pa.array([-(2**63), 1])
    path = written(tmp_path / "a.parquet", {"stamp.sec": least, "stamp.nanosec": pa.array([0, 0]), "x": X[:2]})
    with pytest.raises(InputError, match="impossible time"):
        read(path)
    stamps = pa.array([2**61, 2**61 + 1], pa.timestamp("ms"))
    with pytest.raises(InputError, match="impossible time"):
        read(written(tmp_path / "b.parquet", {"t": stamps, "x": X[:2]}))
    stamps = pa.array([1001, 2999], pa.timestamp("ns"))
    assert read(written(tmp_path / "c.parquet", {"t": stamps, "x": X[:2]})).t_us.tolist() == [1, 2]


LIST_TYPES = [pa.list_(pa.float32(), 3), pa.list_(pa.float32()), pa.large_list(pa.float64()), pa.list_(pa.int64(), 3)]


def lerobot(path: Path, type_: Any, states: list[Any], episodes: list[int], times: list[float]) -> Path:
    """A table with the columns of LeRobot's data files."""
    columns = {
        "observation.state": pa.array(states, type_),
        "action": pa.array([[float(row)] * 2 for row in range(len(states))], pa.list_(pa.float32(), 2)),
        "timestamp": pa.array(times, pa.float32()),
        "episode_index": episodes,
    }
    return written(path, columns, row_group_size=4)


@pytest.mark.parametrize("type_", LIST_TYPES, ids=str)
def test_a_list_is_a_column_per_element(tmp_path: Path, type_: Any) -> None:
    """Assert that elements are columns with their index, over several groups of rows; a missing list is NaN."""
    states: list[Any] = [[row, 10 + row, 20 + row] for row in range(10)]
    states[6] = None
    path = lerobot(tmp_path / "a.parquet", type_, states, [3] * 10, [row / 50 for row in range(10)])
    stream = read(path)
    assert stream.t_us.tolist() == [20_000 * row for row in range(10)]
    names = [f"observation.state_{at}" for at in range(3)]
    assert list(stream.columns) == [*names, "action_0", "action_1", "episode_index"]
    for at, name in enumerate(names):
        expected = [10.0 * at + row if row != 6 else np.nan for row in range(10)]
        np.testing.assert_array_equal(stream.columns[name], expected)
    assert stream.columns["action_1"].tolist() == list(range(10))


def test_several_episodes_are_refused(tmp_path: Path) -> None:
    """Assert that times that begin again in another episode are refused as that, also after an episode of one row."""
    for ends in (5, 1):
        episodes = [4] * ends + [5] * (10 - ends)
        times = [row / 50 for row in (*range(ends), *range(10 - ends))]
        path = lerobot(tmp_path / "a.parquet", LIST_TYPES[0], [[1, 2, 3]] * 10, episodes, times)
        with pytest.raises(InputError, match=rf"row {ends + 1}: the table has several episodes(.|\n)*4(.|\n)*5"):
            read(path)


SAME = {
    "commas": ("t_s,Force [N]\n0.01,1.5\n0.02,2.5\n", "utf-8"),
    "a comma in a name": ("Time (s);Force [N], z\n0.01;1.5\n0.02;2.5\n", "utf-8"),
    "commas in all names": ("Time, (s);Force, [N]\n0,01;1,5\n0,02;2,5\n", "utf-8"),
    "decimal commas": ("t_s;Force [N]\n0,01;1,5\n0,02;2,5\n", "utf-8"),
    "decimal commas after tabs": ("t_s\tForce [N]\n0,01\t1,5\n0,02\t2,5\n", "utf-8"),
    "UTF-16": ("t_s;Force [N];ü\r\n0,01;1,5;a\r\n0,02;2,5;b\r\n", "utf-16"),
    "UTF-8 with a mark": ("t_s,Force [N]\n0.01,1.5\n0.02,2.5\n", "utf-8-sig"),
    "an empty last column": ("t_s,Force [N],\n0.01,1.5,\n0.02,2.5,\n", "utf-8"),
    "a separator after each row": ("t_s;Force [N]\n0,01;1,5;\n0,02;2,5;\n", "utf-8"),
    "a separator after the names": ("t_s,Force [N],\n0.01,1.5\n0.02,2.5\n", "utf-8"),
    "milliseconds in brackets": ("Time [ms],Force [N]\n10.0,1.5\n20.0,2.5\n", "utf-8"),
    "microseconds with a sign": ("t (µs),Force [N]\n10000,1.5\n20000,2.5\n", "utf-8"),
    "milliseconds, a word": ("time (msec),Force [N]\n10.0,1.5\n20.0,2.5\n", "utf-8"),
}


@pytest.mark.parametrize("case", SAME)
def test_ways_of_writing_do_not_change_the_values(tmp_path: Path, case: str) -> None:
    """Assert that times, forces and their unit are the same, and no other column is there."""
    text, encoding = SAME[case]
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    stream, notes = read_table.read_table(tmp_path / "a.csv", None)
    assert stream.t_us.tolist() == [10_000, 20_000]
    ((name, values),) = stream.columns.items()
    assert name.startswith("Force") and values.tolist() == [1.5, 2.5]
    assert stream.units[name] == ("" if case == "a comma in a name" else "N")
    assert notes == (["left out: column ü, which is not numeric"] if "ü" in text else [])


def test_latin_1_is_assumed_and_said(tmp_path: Path) -> None:
    """Assert that text that is not UTF-8 gives the unit that Latin-1 means, with a note."""
    (tmp_path / "a.csv").write_bytes("t_s;Winkel [°]\n0,01;1,5\n".encode("latin-1"))
    stream, notes = read_table.read_table(tmp_path / "a.csv", None)
    assert stream.units == {"Winkel": "°"} and notes == ["the text is not UTF-8; assumed to be Latin-1"]


def test_commas_that_mean_two_things_are_refused(tmp_path: Path) -> None:
    """Assert that decimal commas between commas are not read as other numbers."""
    (tmp_path / "a.csv").write_text("t_s,x\n0,01,1,5\n0,02,2,5\n")
    with pytest.raises(InputError, match="Expected 2 columns, got 4"):
        read_table.read_table(tmp_path / "a.csv", None)


@pytest.mark.parametrize(
    ("step", "rows", "unit"),
    [
        (0.001, 2000, "s"),
        (0.01, 60_000, "s"),
        (0.5, 100, "s"),
        (10.5, 200, ""),
        (0.5, 4000, ""),
    ],
)
def test_an_assumed_unit_fits_the_recording(tmp_path: Path, step: float, rows: int, unit: str) -> None:
    """Assert that fractions are seconds where these fit 2 s, or else refused."""
    lines = [f"{5.25 + at * step:.4f},{at}" for at in range(rows)]
    (tmp_path / "a.csv").write_text("time,x\n" + "\n".join(lines) + "\n")
    if not unit:
        with pytest.raises(InputError, match="the unit of time is unclear"):
            read_table.read_table(tmp_path / "a.csv", None, 2.0)
        return
    stream, _ = read_table.read_table(tmp_path / "a.csv", None, 2.0)
    assert stream.clock == f"column time, assumed to be in {unit}"
    assert stream.t_us[1] - stream.t_us[0] == pytest.approx(step * {"s": 1e6, "ms": 1e3}[unit], abs=1)
