"""A slip detector over images of events: a convolution, the mean over the picture, and a layer for the logit."""

from dataclasses import dataclass
from typing import Any

from evetac_cli.kernels.event_representation import Representation
from evetac_cli.kernels.slip.architectures import PluginImageArchitecture

WIDTH, KERNEL, STRIDE = 8, 5, 2


@dataclass(frozen=True)
class MeanOfPicture(PluginImageArchitecture):
    """Sees the last images of events, the newest first."""

    method = 1

    def layers(self, rows: int, columns: int) -> dict[str, tuple[int, ...]]:
        """The weight of each layer."""
        return {"conv": (WIDTH, self.input_shape[0], KERNEL, KERNEL), "last": (1, WIDTH)}

    def add_layers(self, graph: Any, value: str, rows: int, columns: int) -> str:
        """From inputs (batch, images * channels, height, width) to logits (batch, 1)."""
        value = graph.add("Relu", graph.layer("Conv", value, "conv", strides=[STRIDE, STRIDE]))
        value = graph.add("ReduceMean", value, axes=[2, 3], keepdims=0)
        return graph.layer("Gemm", value, "last", transB=1)

    def modules(self, rows: int, columns: int) -> dict[str, Any]:
        """The layers in torch."""
        from torch import nn

        return {"conv": nn.Conv2d(self.input_shape[0], WIDTH, KERNEL, STRIDE), "last": nn.Linear(WIDTH, 1)}

    def hidden(self, modules: Any, inputs: Any) -> Any:
        """What the last layer gets, (batch, WIDTH)."""
        return modules["conv"](inputs).relu().mean((2, 3))


# Four images of counts, OFF and ON, of 5 ms each.
FRAMES = Representation("frames", frame_px=(640, 480), size_px=(80, 60), rate_hz=200.0, window_ms=5)
MEAN_OF_PICTURE = MeanOfPicture("mean-of-picture", FRAMES, images=4)
