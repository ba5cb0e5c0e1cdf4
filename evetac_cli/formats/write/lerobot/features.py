"""The features of a data set for LeRobot, as described in meta/info.json and in the data card."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

STATE, ACTION, VIDEO = "observation.state", "action", "observation.images.tactile"
INDICES = ("frame_index", "episode_index", "index", "task_index")


class Feature(NamedTuple):
    """A feature: its type, its shape per frame, the names of its values, a text for the card, and further info."""

    dtype: str
    shape: tuple[int, ...]
    names: Sequence[str] | None
    what: str = ""
    info: Mapping[str, Any] | None = None

    def described(self) -> dict[str, Any]:
        """Return the feature as meta/info.json describes it."""
        names = None if self.names is None else list(self.names)
        description = {"dtype": self.dtype, "shape": list(self.shape), "names": names}
        return description if self.info is None else {**description, "info": dict(self.info)}

    @property
    def size(self) -> str:
        """The number of values per frame, as text."""
        height, width = self.shape[:2] if len(self.shape) > 2 else (0, 0)
        return f"{width} x {height} px" if height else " x ".join(map(str, self.shape))


def vector(names: Sequence[str], what: str) -> Feature:
    """Return a feature that is a vector of named numbers."""
    return Feature("float32", (len(names),), names, what)


def video(height: int, width: int, fps: int, what: str) -> Feature:
    """Return a feature that is an RGB video, as `Videos` writes it."""
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
    """Return the features of every data set: the time of a frame and its indices."""
    numbers = {name: Feature("int64", (1,), None) for name in INDICES}
    return {"timestamp": Feature("float32", (1,), None), **numbers}
