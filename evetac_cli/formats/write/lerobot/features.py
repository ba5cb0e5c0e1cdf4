"""The features of a data set for LeRobot: what meta/info.json says of each, and what the data card says of it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

STATE, ACTION, VIDEO = "observation.state", "action", "observation.images.tactile"
INDICES = ("frame_index", "episode_index", "index", "task_index")


class Feature(NamedTuple):
    """A feature: its type, the shape of a frame of it, the names of its values, more of it, and what it is in words."""

    dtype: str
    shape: tuple[int, ...]
    names: Sequence[str] | None
    what: str = ""
    info: Mapping[str, Any] | None = None

    def described(self) -> dict[str, Any]:
        """As meta/info.json has it."""
        names = None if self.names is None else list(self.names)
        made = {"dtype": self.dtype, "shape": list(self.shape), "names": names}
        return made if self.info is None else {**made, "info": dict(self.info)}

    @property
    def size(self) -> str:
        """How many values a frame has, in words."""
        height, width = self.shape[:2] if len(self.shape) > 2 else (0, 0)
        return f"{width} x {height} px" if height else " x ".join(map(str, self.shape))


def vector(names: Sequence[str], what: str) -> Feature:
    """A vector of named numbers."""
    return Feature("float32", (len(names),), names, what)


def video(height: int, width: int, fps: int, what: str) -> Feature:
    """Pictures of red, green and blue in a video, as `Videos` writes it."""
    info = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
    }
    return Feature("video", (height, width, 3), ("height", "width", "channels"), what, info)


def indices() -> dict[str, Feature]:
    """What every data set has: the time of a frame, and the numbers that find it."""
    numbers = {name: Feature("int64", (1,), None) for name in INDICES}
    return {"timestamp": Feature("float32", (1,), None), **numbers}
