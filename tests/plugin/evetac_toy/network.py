"""A slip detector: a layer for each dot, the mean over all dots, and a layer for the logit."""

from dataclasses import dataclass
from typing import Any

from evetac_cli.kernels.slip.architectures import ChannelView, PluginArchitecture

WIDTH = 8


@dataclass(frozen=True)
class MeanOfDots(PluginArchitecture):
    """Written down twice: as torch modules, to be trained, and as nodes of an ONNX graph, to be run."""

    method = 1  # one more whenever it computes other numbers under its name

    def layers(self, rows: int, columns: int) -> dict[str, tuple[int, ...]]:
        """The weight of each layer."""
        return {"code": (WIDTH, self.inputs_per_dot), "last": (1, WIDTH)}

    def add_layers(self, graph: Any, value: str, rows: int, columns: int) -> str:
        """From inputs (batch, dots, inputs_per_dot) to logits (batch, 1)."""
        value = graph.add("Reshape", value, graph.constant("flat", [-1, self.inputs_per_dot]))
        value = graph.add("Relu", graph.layer("Gemm", value, "code", transB=1))
        value = graph.add("Reshape", value, graph.constant("dots", [-1, rows * columns, WIDTH]))
        value = graph.add("ReduceMean", value, axes=[1], keepdims=0)
        return graph.layer("Gemm", value, "last", transB=1)

    def modules(self, rows: int, columns: int) -> dict[str, Any]:
        """The layers in torch, which only `train` imports."""
        from torch import nn

        return {"code": nn.Linear(self.inputs_per_dot, WIDTH), "last": nn.Linear(WIDTH, 1)}

    def hidden(self, modules: Any, inputs: Any) -> Any:
        """What the last layer gets, (batch, WIDTH)."""
        return modules["code"](inputs).relu().mean(1)


MEAN_OF_DOTS = MeanOfDots("mean-of-dots", (ChannelView("distance", 10), ChannelView("events", 10)))
