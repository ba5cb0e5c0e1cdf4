"""Build the ROS 2 messages of each topic that write_mcap writes, in time order, block by block."""

import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.formats.write.slice_columns import TrialFiles
from evetac_cli.jobs import Progress
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings import streams
from evetac_cli.store.recordings.read import BLOCK_SLICES, Recording
from evetac_cli.text_files import as_utf8, parse_json

PACKET = "event_camera_msgs/msg/EventPacket"
US_NS = 1000
TICK_RAD = math.radians(0.088)  # of the RH-P12-RN(A), from its manual
JOINT = "rh_p12_rn"
DOT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "dx", "dy")] + [("events", "<i4"), ("lost", "u1")])
CELL_PA = ("pressure", "pressure_sd", "shear_x", "shear_y", "shear_sd_x", "shear_sd_y")
CELL = np.dtype([(name, "<f4") for name in ("x", "y", "z", *CELL_PA)] + [("patch", "u1")])
TRUE_DOT = np.dtype([(name, "<f4") for name in ("x", "y", "z")])
POINT_FIELDS = {"|u1": 2, "<i4": 5, "<f4": 7}  # of sensor_msgs/PointField
NUMBERS = {  # datasets whose rows each become one message of std_msgs
    "gripper/current_target_ma": "Float64",
    "control/slip": "Bool",
    "control/phase": "UInt8",
    "control/u_ff_ticks": "Float32",
    "control/x_ref_ticks": "Float32",
    "control/probability": "Float32",
    "truth/slip": "Bool",
    "truth/slip_share": "Float32",
    "truth/visible_slip_share": "Float32",
}
M_PER_MM = 1e-3
MOST_IMAGE_BYTES = 1 << 24  # of a stream's images that are read at once

Messages = Iterator[tuple[int, Any]]  # time in us since the start of the recording, message


class TopicMessages:
    """Builds the messages of each topic in time order and reads the files block by block."""

    def __init__(self, types: Any, frame_id: str, offset_us: int) -> None:
        self._types, self._frame_id, self._offset_us = types, frame_id, offset_us

    def __call__(self, kind: str, **values: Any) -> Any:
        """Return a message of a type such as `std_msgs/msg/String`."""
        return self._types[kind](**values)

    def _header(self, t_us: int, *, gel: bool = False) -> Any:
        seconds, us = divmod(self._offset_us + t_us, 10**6)
        stamp = self("builtin_interfaces/msg/Time", sec=seconds, nanosec=us * US_NS)
        frame_id = self._frame_id.replace("evetac", "evetac_gel", 1) if gel else self._frame_id
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def packets(self, recording: Recording, progress: Progress) -> Messages:
        """Yield a packet of events for every slice, also for slices without events: packets mark every slice."""
        width, height = recording.frame_px
        done = 0
        progress(0, recording.event_count)
        for number, events in enumerate(recording):
            begins_us = number * SLICE_US
            words = (events.t - begins_us).astype(np.uint64) * np.uint64(US_NS)
            for column, bit in ((events.x, 32), (events.y, 48), (events.p, 63)):
                words |= column.astype(np.uint64) << np.uint64(bit)
            yield (
                begins_us + SLICE_US,
                self(
                    PACKET,
                    header=self._header(begins_us),
                    height=height,
                    width=width,
                    seq=number,
                    time_base=(self._offset_us + begins_us) * US_NS,
                    encoding="mono",
                    is_bigendian=False,
                    events=words.astype("<u8").view(np.uint8),
                ),
            )
            done += events.size
            if number % BLOCK_SLICES == BLOCK_SLICES - 1 or number == len(recording) - 1:
                progress(done, recording.event_count)

    def of_recording(self, recording: Recording) -> Iterator[tuple[str, str, Messages]]:
        """Yield the topics of gripper, control, marks and truth that the recording has."""
        joint = "sensor_msgs/msg/JointState"
        if recording.has("gripper"):
            rows = _timed(recording, "gripper", "position_ticks", "current_ma")
            yield "/evetac/gripper", joint, ((t_us, self._joint(t_us, *row)) for t_us, *row in rows)
        if recording.has("control"):
            rows = _timed(recording, "control", "goal_ticks")
            yield "/evetac/gripper/goal", joint, ((t_us, self._joint(t_us, *row)) for t_us, *row in rows)
        if recording.has("marks"):
            texts = ((mark.t_us, self("std_msgs/msg/String", data=mark.text)) for mark in recording.marks)
            yield "/evetac/marks", "std_msgs/msg/String", texts
        for path, kind in NUMBERS.items():
            if recording.has(path):
                yield f"/evetac/{path}", f"std_msgs/msg/{kind}", self._numbers(recording, path, kind)
        if recording.has("truth/shear_force_n") and recording.has("truth/normal_force_n"):
            yield (
                "/evetac/truth/force",
                "geometry_msgs/msg/WrenchStamped",
                self._wrenches(recording, "truth/shear_force_n", "truth/normal_force_n"),
            )
        if recording.has("truth"):
            yield "/evetac/truth/dots", "sensor_msgs/msg/PointCloud2", self._true_dots(recording)

    def of_streams(self, recording: Recording) -> Iterator[tuple[str, str, Messages]]:
        """Yield the topics of the trial's other streams, without samples before 0 on the source's clock."""
        paths = recording.contents()
        for name in streams.names(paths):
            group, topic = f"{streams.GROUP}/{name}", f"/evetac/streams/{re.sub('[^A-Za-z0-9_]', '_', name)}"
            about = recording.read(f"{group}/about")
            yield f"{topic}/about", "std_msgs/msg/String", iter([(0, self("std_msgs/msg/String", data=about))])
            columns = [path.rpartition("/")[2] for path in paths if path.startswith(f"{group}/")]
            columns = [column for column in columns if column not in streams.TAKEN]
            if columns:
                units = dict(parse_json(about)).get("units")
                units = units if isinstance(units, dict) else {}
                labels = (f"{column} [{units[column]}]" if column in units else column for column in columns)
                label = as_utf8(", ".join(labels))
                yield topic, "std_msgs/msg/Float64MultiArray", self._columns(recording, group, columns, label)
            if f"{group}/frames" in paths:
                yield f"{topic}/image", "sensor_msgs/msg/Image", self._images(recording, group)

    def _columns(self, recording: Recording, group: str, columns: list[str], label: str) -> Messages:
        size = len(columns)
        dimension = self("std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=size)
        layout = self("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
        for t_us, *row in _timed(recording, group, *columns):
            if t_us >= -self._offset_us:
                yield t_us, self("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(row, np.float64))

    def _images(self, recording: Recording, group: str) -> Messages:
        _, height, width, channels = recording.contents()[f"{group}/frames"][1]
        at_once = max(1, MOST_IMAGE_BYTES // max(1, height * width * channels))
        for t_us, image in _timed(recording, group, "frames", at_once=at_once):
            if t_us >= -self._offset_us:
                yield (
                    t_us,
                    self(
                        "sensor_msgs/msg/Image",
                        header=self._header(t_us),
                        height=height,
                        width=width,
                        encoding="mono8" if channels == 1 else "rgb8",
                        is_bigendian=0,
                        step=width * channels,
                        data=image.reshape(-1),
                    ),
                )

    def of_files(self, files: TrialFiles) -> Iterator[tuple[str, str, Messages]]:
        """Yield the topics of tracks, touch and labels that the trial has."""
        tracks, touch, labels = (files.by_kind.get(kind) for kind in ("tracks", "touch", "labels"))
        if tracks is not None:
            yield "/evetac/dots", "sensor_msgs/msg/PointCloud2", self._dots(tracks)
        if touch is not None:
            wrench = "geometry_msgs/msg/WrenchStamped"
            yield "/evetac/force", wrench, self._wrenches(touch, "shear_n", "normal_n", "torsion_n_mm")
            yield "/evetac/force/sd", wrench, self._wrenches(touch, "shear_sd_n", "normal_sd_n", "torsion_sd_n_mm")
            yield "/evetac/touch/centre", "geometry_msgs/msg/PointStamped", self._centres(touch)
            yield (
                "/evetac/touch/sticking_share",
                "std_msgs/msg/Float32",
                self._numbers(touch, "sticking_share", "Float32"),
            )
            if touch.has("map/slice"):
                yield "/evetac/touch/map", "sensor_msgs/msg/PointCloud2", self._maps(touch)
        if labels is not None:
            yield "/evetac/label", "std_msgs/msg/Int8", self._numbers(labels, "label", "Int8")

    def _joint(self, t_us: int, ticks: int, current_ma: float | None = None) -> Any:
        effort = [] if current_ma is None else [float(current_ma)]
        return self(
            "sensor_msgs/msg/JointState",
            header=self._header(t_us),
            name=[JOINT],
            position=np.array([ticks * TICK_RAD]),
            velocity=np.empty(0),
            effort=np.array(effort),
        )

    def _numbers(self, file: StageFile, path: str, kind: str) -> Messages:
        """Yield one message per row; gripper and control have their own times, except the detector's output."""
        group, _, name = path.rpartition("/")
        timed = group in ("gripper", "control") and name != "probability"
        rows = _timed(file, group, name) if timed else _by_slice(file, path)
        for t_us, value in rows:
            yield t_us, self(f"std_msgs/msg/{kind}", data=value.item())

    def _wrenches(self, file: StageFile, shear: str, normal: str, torsion: str = "") -> Messages:
        """Yield one wrench per slice; the file's torque is in N mm."""
        for t_us, (x, y), z, *torque in _by_slice(file, shear, normal, *([torsion] if torsion else [])):
            turn = float(torque[0]) * M_PER_MM if torque else 0.0
            wrench = self(
                "geometry_msgs/msg/Wrench",
                force=self("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z)),
                torque=self("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=turn),
            )
            yield t_us, self("geometry_msgs/msg/WrenchStamped", header=self._header(t_us), wrench=wrench)

    def _centres(self, touch: StageFile) -> Messages:
        """Yield the centre of pressure of every slice with contact."""
        for t_us, (x, y) in _by_slice(touch, "centre_mm"):
            if np.isfinite(x + y):
                point = self("geometry_msgs/msg/Point", x=float(x) * M_PER_MM, y=float(y) * M_PER_MM, z=0.0)
                yield t_us, self("geometry_msgs/msg/PointStamped", header=self._header(t_us, gel=True), point=point)

    def _maps(self, touch: StageFile) -> Messages:
        """Yield one point cloud per map, with the rows and columns of its cells."""
        x_mm, y_mm = touch.read("map/x_mm"), touch.read("map/y_mm")
        cells, fields = np.zeros((len(y_mm), len(x_mm)), CELL), self._fields(CELL)
        cells["x"], cells["y"] = x_mm * M_PER_MM, y_mm[:, None] * M_PER_MM
        names = ("slice", "patch", "pressure_pa", "pressure_sd_pa", "shear_pa", "shear_sd_pa")
        for row in range(touch.length("map/slice")):
            at, patch, pressure, pressure_sd, shear, shear_sd = (
                touch.read(f"map/{name}", row, row + 1)[0] for name in names
            )
            cells["patch"], cells["pressure"], cells["pressure_sd"] = patch, pressure, pressure_sd
            cells["shear_x"], cells["shear_y"] = shear
            cells["shear_sd_x"], cells["shear_sd_y"] = shear_sd
            t_us = (int(at) + 1) * SLICE_US
            yield t_us, self._cloud(t_us, cells, fields, gel=True)

    def _dots(self, tracks: StageFile) -> Messages:
        rest = tracks.read("sensor/dot_xy_px")
        shape = rest.shape[:2]
        dots, fields = np.zeros(shape, DOT), self._fields(DOT)
        for t_us, xy, events, lost in _by_slice(tracks, "dot_xy_px", "events_per_dot", "lost"):
            xy = xy.reshape(*shape, 2)  # noqa: PLW2901
            dots["x"], dots["y"] = xy[..., 0], xy[..., 1]
            dots["dx"], dots["dy"] = xy[..., 0] - rest[..., 0], xy[..., 1] - rest[..., 1]
            dots["events"], dots["lost"] = events.reshape(shape), lost.reshape(shape)
            yield t_us, self._cloud(t_us, dots, fields)

    def _true_dots(self, recording: Recording) -> Messages:
        fields = self._fields(TRUE_DOT)
        for t_us, xy in _by_slice(recording, "truth/dot_xy_px"):
            dots = np.zeros((1, len(xy)), TRUE_DOT)
            dots["x"], dots["y"] = xy[:, 0], xy[:, 1]
            yield t_us, self._cloud(t_us, dots, fields)

    def _fields(self, point: np.dtype[Any]) -> list[Any]:
        kind = "sensor_msgs/msg/PointField"
        return [
            self(kind, name=name, offset=offset, datatype=POINT_FIELDS[of.str], count=1)
            for name, (of, offset, *_) in (point.fields or {}).items()
        ]

    def _cloud(self, t_us: int, dots: NDArray[Any], fields: list[Any], *, gel: bool = False) -> Any:
        return self(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(t_us, gel=gel),
            height=dots.shape[0],
            width=dots.shape[1],
            fields=fields,
            is_bigendian=False,
            point_step=dots.dtype.itemsize,
            row_step=dots.dtype.itemsize * dots.shape[1],
            data=np.frombuffer(dots.tobytes(), np.uint8),
            is_dense=bool(np.isfinite(dots["x"]).all()),
        )


def _by_slice(file: StageFile, *paths: str) -> Iterator[tuple[Any, ...]]:
    """Yield the end of each slice, in us, and its row of each dataset."""
    for first in range(0, file.length(paths[0]), BLOCK_SLICES):
        columns = [file.read(path, first, first + BLOCK_SLICES) for path in paths]
        ends = ((first + 1 + np.arange(len(columns[0]))) * SLICE_US).tolist()
        yield from zip(ends, *columns, strict=True)


def _timed(file: StageFile, group: str, *names: str, at_once: int = BLOCK_SLICES) -> Iterator[tuple[Any, ...]]:
    """Yield the time of each row of a group that has its own clock, in us, and its value in each dataset."""
    for first in range(0, file.length(f"{group}/t_us"), at_once):
        t_us, *columns = (file.read(f"{group}/{name}", first, first + at_once) for name in ("t_us", *names))
        yield from zip(t_us.tolist(), *columns, strict=True)
