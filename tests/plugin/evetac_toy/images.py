"""A slip detector on event images: a convolution, the mean over the image, and a layer that returns the logit."""

from dataclasses import dataclass
from typing import Any

from evetac_cli.kernels.event_representation import Representation
from evetac_cli.kernels.slip.architectures import PluginImageArchitecture

WIDTH, KERNEL, STRIDE = 8, 5, 2


@dataclass(frozen=True)
class MeanOfPicture(PluginImageArchitecture):
    """The network; its input is the last event images, newest first."""

    method = 1

    def layers(self, rows: int, columns: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of each layer's weights."""
        return {"conv": (WIDTH, self.input_shape[0], KERNEL, KERNEL), "last": (1, WIDTH)}

    def add_layers(self, graph: Any, value: str, rows: int, columns: int) -> str:
        """Add the ONNX nodes from inputs (batch, images * channels, height, width) to logits (batch, 1)."""
        value = graph.add("Relu", graph.layer("Conv", value, "conv", strides=[STRIDE, STRIDE]))
        value = graph.add("ReduceMean", value, axes=[2, 3], keepdims=0)
        return graph.layer("Gemm", value, "last", transB=1)

    def modules(self, rows: int, columns: int) -> dict[str, Any]:
        """Return the layers as torch modules."""
        from torch import nn

        return {"conv": nn.Conv2d(self.input_shape[0], WIDTH, KERNEL, STRIDE), "last": nn.Linear(WIDTH, 1)}

    def hidden(self, modules: Any, inputs: Any) -> Any:
        """Return the inputs of the last layer, (batch, WIDTH)."""
        return modules["conv"](inputs).relu().mean((2, 3))


# Four images, each with the counts of OFF and ON events over 5 ms.
FRAMES = Representation("frames", frame_px=(640, 480), size_px=(80, 60), rate_hz=200.0, window_ms=5)
MEAN_OF_PICTURE = MeanOfPicture("mean-of-picture", FRAMES, images=4)
