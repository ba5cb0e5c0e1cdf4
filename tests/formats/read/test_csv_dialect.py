"""CSV files as programs of several countries write them: the same values, whatever the separator and the encoding."""

from pathlib import Path

import pytest

from evetac_cli.errors import InputError
from evetac_cli.formats.read.csv_dialect import SAMPLE_BYTES
from evetac_cli.formats.read.read_table import read_table

pytest.importorskip("pyarrow")

SAME = {
    "commas": ("t_s,Force [N]\n0.01,1.5\n0.02,2.5\n", "utf-8"),
    "a comma in a name": ("Time (s);Force [N], z\n0.01;1.5\n0.02;2.5\n", "utf-8"),
    "commas in all names": ("Time, (s);Force, [N]\n0,01;1,5\n0,02;2,5\n", "utf-8"),
    "decimal commas": ("t_s;Force [N]\n0,01;1,5\n0,02;2,5\n", "utf-8"),
    "decimal commas after tabs": ("t_s\tForce [N]\n0,01\t1,5\n0,02\t2,5\n", "utf-8"),
    "decimal commas in quotes": ('t_s,Force [N]\n"0,01","1,5"\n"0,02","2,5"\n', "utf-8"),
    "UTF-16": ("t_s;Force [N];ü\r\n0,01;1,5;a\r\n0,02;2,5;b\r\n", "utf-16"),
    "UTF-16 without a mark": ("t_s;Force [N];ü\r\n0,01;1,5;a\r\n0,02;2,5;b\r\n", "utf-16-le"),
    "UTF-8 with a mark": ("t_s,Force [N]\n0.01,1.5\n0.02,2.5\n", "utf-8-sig"),
    "Excel's line before the names": ("sep=;\r\nt_s;Force [N]\r\n0,01;1,5\r\n0,02;2,5\r\n", "utf-8-sig"),
    "a stated separator that also fits otherwise": ("sep=,\nt_s,Force [N]\n0.01,1.5\n0.02,2.5\n", "utf-8"),
    "durations of pandas": ("t,Force [N]\n0 days 00:00:00.010000,1.5\n0 days 00:00:00.020000,2.5\n", "utf-8"),
    "durations without days": ("t;Force [N]\n00:00:00,01;1,5\n00:00:00,02;2,5\n", "utf-8"),
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
    stream, notes = read_table(tmp_path / "a.csv", None)
    assert stream.t_us.tolist() == [10_000, 20_000]
    ((name, values),) = stream.columns.items()
    assert name.startswith("Force") and values.tolist() == [1.5, 2.5]
    assert stream.units[name] == ("" if case == "a comma in a name" else "N")
    assert notes == (["left out: column ü, which is not numeric"] if "ü" in text else [])


@pytest.mark.parametrize("separator", [";", ","])
def test_decimal_commas_may_come_late(tmp_path: Path, separator: str) -> None:
    """Assert that decimal commas are found beyond the part of the file that shows the separator."""
    quote = '"' if separator == "," else ""
    rows = [f"{at}{separator}{at}" for at in range(40_000)]
    rows[-1] = f"39999{separator}{quote}39999,5{quote}"
    text = f"t_ms{separator}x\n" + "\n".join(rows)
    assert len(text) > SAMPLE_BYTES
    (tmp_path / "a.csv").write_text(text)
    stream, notes = read_table(tmp_path / "a.csv", None)
    assert stream.columns["x"][[0, -2, -1]].tolist() == [0, 39998, 39999.5] and notes == []


def test_durations_of_pandas_may_be_negative(tmp_path: Path) -> None:
    """Assert days, hours and a sign, in a column without a name, and that a row without a duration is refused."""
    rows = ["-1 days +23:59:59.5,1", "0 days 00:00:00,2", "1 days 02:00:00.25,3"]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",x", *rows]))
    stream, _ = read_table(path, None)
    assert stream.t_us.tolist() == [-500_000, 0, 93_600_250_000]
    path.write_text("\n".join([",x", *rows, "NaT,4"]))
    with pytest.raises(InputError, match=r"row 4(.|\n)*the row has no time|the row has no time(.|\n)*row 4"):
        read_table(path, None)


def test_latin_1_is_assumed_and_said(tmp_path: Path) -> None:
    """Assert that text that is not UTF-8 gives the unit that Latin-1 means, with a note."""
    (tmp_path / "a.csv").write_bytes("t_s;Winkel [°]\n0,01;1,5\n".encode("latin-1"))
    stream, notes = read_table(tmp_path / "a.csv", None)
    assert stream.units == {"Winkel": "°"} and notes == ["the text is not UTF-8; assumed to be Latin-1"]


def test_commas_that_mean_two_things_are_refused(tmp_path: Path) -> None:
    """Assert that decimal commas between commas are not read as other numbers."""
    (tmp_path / "a.csv").write_text("t_s,x\n0,01,1,5\n0,02,2,5\n")
    with pytest.raises(InputError, match="Expected 2 columns, got 4"):
        read_table(tmp_path / "a.csv", None)


@pytest.mark.parametrize(
    ("step", "rows", "unit"),
    [
        (0.001, 2000, "s"),
        (0.01, 60_000, "s"),
        (0.5, 100, "s"),
        (10.5, 200, "ms"),
        (1.0003, 2000, "ms"),
        (0.5, 4000, ""),
    ],
)
def test_an_assumed_unit_fits_the_recording(tmp_path: Path, step: float, rows: int, unit: str) -> None:
    """Assert that fractions are seconds, or milliseconds where only these fit 2 s, or refused if both could be."""
    lines = [f"{5.25 + at * step:.4f},{at}" for at in range(rows)]
    (tmp_path / "a.csv").write_text("time,x\n" + "\n".join(lines) + "\n")
    if not unit:
        with pytest.raises(InputError, match=r"the unit of time is unclear(.|\n)*name the column t_s, t_ms"):
            read_table(tmp_path / "a.csv", None, 2.0)
        return
    stream, _ = read_table(tmp_path / "a.csv", None, 2.0)
    assert stream.clock == f"column time, assumed to be in {unit}"
    assert stream.t_us[1] - stream.t_us[0] == pytest.approx(step * {"s": 1e6, "ms": 1e3}[unit], abs=1)
