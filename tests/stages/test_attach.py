"""attach: streams of other programs in a recording, aligned by their clock, and what other commands make of them."""

import json
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.commands.attach import Attach
from evetac_cli.commands.trim import Trim
from evetac_cli.commands.view import View
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.formats import exports
from evetac_cli.formats.read.bags import read_bag_stream
from evetac_cli.inspect import info, validate
from evetac_cli.pages import view
from evetac_cli.stages import attach, trim
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import event_arrays, run_stage

pytest.importorskip("pyarrow")
pytest.importorskip("rosbags.rosbag1")
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).resolve().parents[2]
START_S = 1_700_000_000  # of the recording, in the clock of its event file
SLICES = 100


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording of 0.1 s, as an import leaves it."""
    t = np.arange(0, 1000 * SLICES, 500)
    events = Events(t, np.full(t.size, 3, np.uint16), np.full(t.size, 2, np.uint16), np.ones(t.size, np.uint8))
    arrays = event_arrays(events, SLICES, (8, 6), START_S * 10**6)
    path = tmp_path / "a.recording.h5"
    write_stage(path, Recipe("recording", 2, {"source": "a.aedat4"}, content="0" * 64), arrays)
    return path


def attached(recording: Path, *given: str, offset: Sequence[str] = (), **options: Any) -> tuple[Path, dict[str, Any]]:
    """The recording with streams, and the row of the command."""
    chosen = Attach(stream=list(given), offset=list(offset))
    (job,) = attach.jobs([recording], chosen, options.pop("out", None))
    (row,) = attach.run(job, chosen, **options).rows
    return job.output, row


def pose_csv(folder: Path, first_s: float = START_S - 0.02, rows: int = 20, name: str = "pose.csv") -> Path:
    """A pose every 10 ms, the first two rows before the recording, and some after it."""
    lines = [f"{first_s + at / 100:.6f},{at / 8},{-at},base" for at in range(rows)]
    (folder / name).write_text("timestamp,x_m,force [N],frame\n" + "\n".join(lines) + "\n")
    return folder / name


def bag(folder: Path, kind: str) -> Path:
    """The same as a bag: poses, forces, joints, and images, plain and packed, every 10 ms."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)

    def make(name: str, *values: Any) -> Any:
        return store.types[name](*values)

    def header(at: int) -> Any:
        ns = START_S * 10**9 + at * 10**7
        stamp = make("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)
        return make("std_msgs/msg/Header", *([7] if kind == "ros1" else []), stamp, "base")

    def pose(at: int) -> Any:
        xyz, quaternion = (
            make("geometry_msgs/msg/Point", at / 8, 0.0, 0.0),
            make("geometry_msgs/msg/Quaternion", 0, 0, 0, 1),
        )
        return make("geometry_msgs/msg/PoseStamped", header(at), make("geometry_msgs/msg/Pose", xyz, quaternion))

    def joints(at: int) -> Any:
        none = np.empty(0)
        return make("sensor_msgs/msg/JointState", header(at), ["elbow", "wrist"], np.array([at, 1.5]), none, none)

    def number(at: int) -> Any:
        return make("std_msgs/msg/Float64", float(at))

    def image(at: int) -> Any:
        rows = np.zeros((6, 9), np.uint8)  # three bytes a row that belong to no pixel
        rows[:, :6] = np.arange(6) + at
        return make("sensor_msgs/msg/Image", header(at), 6, 2, "bgr8", 0, 9, rows.reshape(-1))

    def packed(at: int) -> Any:
        import cv2

        grey = np.full((6, 8), 10 * at, np.uint8)
        return make("sensor_msgs/msg/CompressedImage", header(at), "png", cv2.imencode(".png", grey)[1].reshape(-1))

    path = folder / (f"{kind}.bag" if kind == "ros1" else kind)
    if kind == "ros1":
        writer: Any = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    topics = {"/pose": pose, "/joints": joints, "/number": number, "/image": image, "/packed": packed}
    with writer:
        for topic, made in topics.items():
            connection = writer.add_connection(topic, made(0).__msgtype__, typestore=store)
            for at in range(5):
                message = made(at)
                serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
                raw = serialize(message, message.__msgtype__)
                writer.write(connection, START_S * 10**9 + at * 10**7 + 4_000_000, raw)
    return path


def about(file: StageFile, name: str) -> dict[str, Any]:
    return dict(json.loads(file.read(f"streams/{name}/about")))


def test_csv_is_aligned_by_its_clock(recording: Path, tmp_path: Path) -> None:
    """Assert that times come into the recording's clock, samples outside are counted, and texts are named."""
    output, row = attached(recording, f"arm={pose_csv(tmp_path)}")
    assert output.name == "a-streams.recording.h5"
    with StageFile(output, "recording") as file:
        assert file.read("streams/arm/t_us").tolist() == [10_000 * at for at in range(10)]
        assert file.read("streams/arm/x_m").tolist() == [(at + 2) / 8 for at in range(10)]
        assert file.read("streams/arm/force").tolist() == [-at - 2 for at in range(10)]
        said = about(file, "arm")
        assert said["units"] == {"x_m": "m", "force": "N"}
        assert (said["left_out"], said["source"], said["clock"]) == (
            10,
            "pose.csv",
            "column timestamp, assumed to be in s",
        )
        with StageFile(recording) as source:
            assert file.header["parents"] == [source.header["id"]]
            assert not file.header["simulated"]
            for name in source.contents():
                np.testing.assert_array_equal(file.read(name), source.read(name))
    assert row["left_out"] == 10
    assert "column frame, which is not numeric" in row["notes"]
    assert [row["faults"] for row in validate.run([output]).rows] == [None]


def test_same_recipe_same_arrays(recording: Path, tmp_path: Path) -> None:
    """Assert that what is there is not made again, and that other samples are another recipe, which is refused."""
    source = pose_csv(tmp_path)
    output, first = attached(recording, f"arm={source}")
    _, second = attached(recording, f"arm={source}")
    assert (first["status"], second["status"]) == ("made", "up to date")
    source.write_text(source.read_text().replace(",-5,", ",-5.5,"))
    with pytest.raises(InputError, match="another recipe"):
        attached(recording, f"arm={source}")
    attached(recording, f"arm={source}", force=True)
    with StageFile(output) as file:
        assert -5.5 in file.read("streams/arm/force")


def test_validate_sees_a_changed_sample(recording: Path, tmp_path: Path) -> None:
    """Assert that the samples are part of the recipe, as the events of an import are."""
    output, _ = attached(recording, f"arm={pose_csv(tmp_path)}")
    with h5py.File(output, "r+") as h5:
        h5["streams/arm/x_m"][3] = 99.0
    (row,) = validate.run([output]).rows
    assert "digest is not the one in the header" in row["faults"]


def test_parquet_says_what_csv_says(recording: Path, tmp_path: Path) -> None:
    """Assert that a table is the same from Parquet, with times of a type that says their unit."""
    import pandas

    frame = pandas.read_csv(pose_csv(tmp_path))
    frame["timestamp"] = pandas.to_datetime((frame["timestamp"] * 1e6).round().astype("int64"), unit="us")
    frame.to_parquet(tmp_path / "pose.parquet")
    output, _ = attached(recording, f"arm={tmp_path / 'pose.csv'}", f"again={tmp_path / 'pose.parquet'}")
    with StageFile(output) as file:
        for name in ("t_us", "x_m", "force"):
            np.testing.assert_array_equal(file.read(f"streams/again/{name}"), file.read(f"streams/arm/{name}"))
        assert about(file, "again")["clock"] == "column timestamp, whose type states its unit"


@pytest.mark.parametrize("kind", ["ros1", pytest.param("db3", marks=pytest.mark.slow), "mcap"])
def test_bags(recording: Path, tmp_path: Path, kind: str) -> None:
    """Assert that poses, joints, plain numbers and images of a bag come out as they were put in, with their units."""
    path = bag(tmp_path, kind)
    names = {"arm": "/pose", "joints": "/joints", "number": "/number", "wrist": "/image", "packed": "/packed"}
    output, _ = attached(recording, *(f"{name}={path}:{topic}" for name, topic in names.items()))
    with StageFile(output) as file:
        for name in set(names) - {"number"}:
            assert file.read(f"streams/{name}/t_us").tolist() == [10_000 * at for at in range(5)]
            assert about(file, name)["clock"] == "header.stamp"
        assert file.read("streams/number/t_us").tolist() == [10_000 * at + 4000 for at in range(5)]
        assert file.read("streams/number/data").tolist() == [0, 1, 2, 3, 4]
        assert file.read("streams/arm/pose.position.x").tolist() == [at / 8 for at in range(5)]
        assert file.read("streams/arm/pose.orientation.w").tolist() == [1.0] * 5
        assert about(file, "arm")["units"] == {f"pose.position.{axis}": "m" for axis in "xyz"}
        assert file.read("streams/joints/position.elbow").tolist() == [0, 1, 2, 3, 4]
        frames = file.read("streams/wrist/frames")
        assert frames.shape == (5, 6, 2, 3)
        assert frames[1, 0].tolist() == [[3, 2, 1], [6, 5, 4]]  # red, green, blue
        assert file.read("streams/packed/frames")[:, 0, 0, 0].tolist() == [0, 10, 20, 30, 40]
    assert [row["faults"] for row in validate.run([output]).rows] == [None]


def test_large_images_can_be_read_again(recording: Path, tmp_path: Path) -> None:
    """Assert that an image larger than a chunk may be is stored in several, and read back as it was."""
    from evetac_cli.store.recordings.streams import Stream

    frames = np.random.default_rng(0).integers(0, 256, (2, 700, 600, 3), np.uint8)
    stream = Stream("wrist", np.array([0, 10_000]), frames=frames)
    with StageFile(recording) as source:
        arrays = {name: source.read(name) for name in source.contents()}
    write_stage(tmp_path / "b.recording.h5", Recipe("recording", 1, {}, seed=1), arrays | stream.datasets())
    with StageFile(tmp_path / "b.recording.h5") as file:
        np.testing.assert_array_equal(file.read("streams/wrist/frames"), frames)
    with h5py.File(tmp_path / "b.recording.h5") as h5:
        assert h5["streams/wrist/frames"].chunks == (1, 582, 600, 3)


def test_trim_cuts_streams_in_time(recording: Path, tmp_path: Path) -> None:
    """Assert that a piece has the samples of its own time, in its own clock, and what they are."""
    whole, _ = attached(recording, f"arm={pose_csv(tmp_path)}", f"wrist={bag(tmp_path, 'ros1')}:/image")
    chosen = Trim(from_ms=20, to_ms=45)
    output, _ = run_stage(trim, [whole], chosen, tmp_path / "piece.recording.h5")
    with StageFile(whole) as source, StageFile(output) as piece:
        assert piece.contents().keys() == source.contents().keys()
        assert piece.read("streams/arm/t_us").tolist() == [0, 10_000, 20_000]
        np.testing.assert_array_equal(piece.read("streams/arm/x_m"), source.read("streams/arm/x_m", 2, 5))
        np.testing.assert_array_equal(piece.read("streams/wrist/frames"), source.read("streams/wrist/frames", 2, 5))
        assert about(piece, "arm") == about(source, "arm")


def test_info_and_view_show_streams(recording: Path, tmp_path: Path) -> None:
    """Assert that info lists samples, rate and span, and that a page draws columns and the images at their times."""
    output, _ = attached(recording, f"arm={pose_csv(tmp_path)}", f"wrist={bag(tmp_path, 'ros1')}:/image")
    (row,) = info.run([output]).rows
    assert row["stream_arm"] == "numbers, 10 samples of 2 columns, 100 Hz, 0.000 to 0.090 s"
    assert row["stream_wrist"] == "sensor_msgs/Image, 5 frames of 2 x 6 px, 100 Hz, 0.000 to 0.040 s"
    assert row["groups"] == "streams"
    page = tmp_path / "a.html"
    (shown,) = view.run([output], View(images=20), page).rows
    assert shown["series"] == 3
    text = page.read_text()
    assert "<figcaption>wrist</figcaption>" in text
    data = json.loads(text.split('<script type="application/json" id="data">')[1].split("</script>")[0])
    (camera,) = data["cameras"]
    assert len(camera["images"]) == 5
    times = [0 if end <= 0 else min(4, (end - 1) // 10) for end in (min(at + 5, SLICES) for at in data["frame_times"])]
    assert camera["shown"] == times


def test_other_readers(recording: Path, tmp_path: Path) -> None:
    """Assert that xarray reads a stream as a table with units, and that exports of events say that it is left out."""
    output, _ = attached(recording, f"arm={pose_csv(tmp_path)}")
    with xarray.open_dataset(output, group="streams/arm", engine="h5netcdf") as opened:
        table = opened.load()
    assert table["force"].attrs["units"] == "N"
    assert table["x_m"].dims == ("samples",)
    assert table["x_m"].values.tolist() == [(at + 2) / 8 for at in range(10)]
    row = exports.export(output, "text", tmp_path / "a.txt")
    assert "streams" in json.dumps(row)


def test_the_commands_of_the_page(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the commands of docs/streams.md do what the page says, and that its Python reads what they made."""
    import pandas

    monkeypatch.chdir(tmp_path)
    recording.rename("touch.recording.h5")
    pandas.read_csv(pose_csv(tmp_path)).to_parquet("ft.parquet")
    bag(tmp_path, "ros1").rename("trial.bag")
    page = (ROOT / "docs" / "streams.md").read_text()
    for line in re.findall(r"^evetac .*$", "".join(re.findall(r"^```sh\n(.*?)^```", page, re.M | re.S)), re.M):
        result = CliRunner().invoke(app, shlex.split(line)[1:])
        assert result.exit_code == 0, result.output
    with StageFile(Path("touch-streams.recording.h5")) as file:
        assert file.read("streams/force/t_us", 0, 1).tolist() == [2000]
    with StageFile(Path("with-bag.recording.h5")) as file:
        assert file.has("streams/wrist/frames")
    (python,) = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    names: dict[str, Any] = {}
    exec(python, names)
    assert names["frame"]["x_m"].tolist() == [(at + 2) / 8 for at in range(10)]


def test_a_packed_image_is_bounded_by_its_pixels(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a JPEG or PNG is refused by its size before it is unpacked, and a plain image is not."""
    path = bag(tmp_path, "ros1")
    monkeypatch.setattr(read_bag_stream, "MOST_PACKED_PX", 6 * 8 - 1)
    with pytest.raises(InputError, match=r"a compressed image is too large(.|\n)*8 x 6"):
        attached(recording, f"wrist={path}:/packed")
    attached(recording, f"wrist={path}:/image")


REFUSED = {
    "backwards": ("t_s,x\n1,2\n0.5,3\n", "go backwards"),
    "no time": ("x,y\n1,2\n", "no column of times"),
    "nan": (f"t_s,x\n{START_S}.01,1\nnan,2\n", "the row has no time"),
    "infinite": (f"t_s,x\n{START_S}.01,1\ninf,2\n", "the time is not a number"),
    "infinite value": (f"t_s,x\n{START_S}.01,-inf\n", "infinite value in the column x"),
    "empty time": (f"t_s,x\n{START_S}.01,1\n,2\n", "the row has no time"),
    "elsewhere": ("t_s,x\n1,2\n2,3\n", "no sample of arm"),
    "which unit": ("time,x\n1,2\n2,3\n", "the unit of time is unclear"),
    "far": ("t_s,x\n1e30,2\n", "impossible time"),
    "no names": ("1.5,2\n2.5,3\n", "does not name the columns"),
    "no numbers": ("t_s,x\n1,a\n", "no column of numbers"),
    "no rows": ("t_s,x\n", "no row|cannot be read"),
    "ragged": ("t_s,x\n1,2\n3\n", "cannot be read"),
    "empty": ("", "neither a table nor a bag"),
    "bytes": ("\x00\x01\x02", "neither a table nor a bag"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused(recording: Path, tmp_path: Path, case: str) -> None:
    """Assert that a stream that makes no sense is refused in words, and nothing is written."""
    content, said = REFUSED[case]
    (tmp_path / "pose.csv").write_text(content)
    with pytest.raises(InputError, match=said) as refused:
        attached(recording, f"arm={tmp_path / 'pose.csv'}")
    assert "pose.csv" in str(refused.value)
    assert not (tmp_path / "a-streams.recording.h5").exists()


def test_the_offset_that_would_align_is_named(recording: Path, tmp_path: Path) -> None:
    """Assert that a stream elsewhere in time is refused with the offset by which both begin together, and it fits."""
    source = pose_csv(tmp_path, first_s=2.5)
    with pytest.raises(InputError, match="no sample of arm") as refused:
        attached(recording, f"arm={source}")
    assert refused.value.hint.startswith(f"--offset arm={START_S - 2.5:.6f} ")
    output, _ = attached(recording, f"arm={source}", offset=[refused.value.hint.split()[1]])
    with StageFile(output) as file:
        assert file.read("streams/arm/t_us", 0, 1).tolist() == [0]


@pytest.mark.parametrize(
    ("stream", "offset", "said"),
    [
        ([], [], "no stream to add"),
        (["pose.csv"], [], "cannot be read"),
        (["a b=pose.csv"], [], "letters, digits"),
        (["arm=pose.csv", "arm=pose.csv"], [], "given twice"),
        (["arm=pose.csv"], ["foot=1"], "no such stream"),
        (["arm=pose.csv"], ["arm=soon"], "not an offset"),
        (["arm=pose.csv"], ["arm=nan"], "not an offset"),
        (["arm=missing.csv"], [], "missing.csv"),
        (["arm=pose.csv:/topic"], [], "not a bag"),
        (["arm=ros1.bag:/none"], [], "no such topic"),
        (["arm=ros1.bag"], [], "or several"),
    ],
)
def test_what_is_asked_for_wrongly(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stream: list[str], offset: list[str], said: str
) -> None:
    """Assert that flags, files and topics that are not there are refused by name."""
    monkeypatch.chdir(tmp_path)
    pose_csv(tmp_path)
    bag(tmp_path, "ros1")
    with pytest.raises((InputError, FileNotFoundError), match=said):
        attached(recording, *stream, offset=offset)
