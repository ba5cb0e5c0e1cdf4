"""A slip detector on dots: a layer for each dot, the mean over all dots, and a layer that returns the logit."""

from dataclasses import dataclass
from typing import Any

from evetac_cli.kernels.slip.architectures import ChannelView, PluginArchitecture

WIDTH = 8


@dataclass(frozen=True)
class MeanOfDots(PluginArchitecture):
    """The network, defined twice: as torch modules for training, and as ONNX nodes for inference."""

    method = 1  # add one when a change of the code makes the network compute other numbers

    def layers(self, rows: int, columns: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of each layer's weights."""
        return {"code": (WIDTH, self.inputs_per_dot), "last": (1, WIDTH)}

    def add_layers(self, graph: Any, value: str, rows: int, columns: int) -> str:
        """Add the ONNX nodes from inputs (batch, dots, inputs_per_dot) to logits (batch, 1)."""
        value = graph.add("Reshape", value, graph.constant("flat", [-1, self.inputs_per_dot]))
        value = graph.add("Relu", graph.layer("Gemm", value, "code", transB=1))
        value = graph.add("Reshape", value, graph.constant("dots", [-1, rows * columns, WIDTH]))
        value = graph.add("ReduceMean", value, axes=[1], keepdims=0)
        return graph.layer("Gemm", value, "last", transB=1)

    def modules(self, rows: int, columns: int) -> dict[str, Any]:
        """Return the layers as torch modules; only `train` imports torch."""
        from torch import nn

        return {"code": nn.Linear(self.inputs_per_dot, WIDTH), "last": nn.Linear(WIDTH, 1)}

    def hidden(self, modules: Any, inputs: Any) -> Any:
        """Return the inputs of the last layer, (batch, WIDTH)."""
        return modules["code"](inputs).relu().mean(1)


MEAN_OF_DOTS = MeanOfDots("mean-of-dots", (ChannelView("distance", 10), ChannelView("events", 10)))
