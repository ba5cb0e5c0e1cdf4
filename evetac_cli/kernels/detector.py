"""Run a trained slip detector from its ONNX graph: one window at a time while grasping, or over a whole trajectory."""

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from evetac_cli.kernels import features, slip

BATCH = 2048  # windows at a time, 10 MB for hist10


class Detector:
    """A network of the paper's kind behind onnxruntime, on one thread (faster than two for networks this small)."""

    def __init__(self, graph: bytes, architecture: slip.Architecture) -> None:
        """Load a graph as kept in a model file; ValueError if onnxruntime refuses it."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its own without a common, importable base
            raise ValueError(f"expected an ONNX graph, found bytes that onnxruntime refuses: {error}") from error
        self.architecture = architecture

    def probability(self, windows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Slip probability (k,) of windows (k, dots, 2 history) as made by `features`."""
        (probability,) = self._session.run(None, {"features": slip.inputs(self.architecture, windows)})
        return np.asarray(probability, np.float32).reshape(-1)

    def over(self, displacement_px: NDArray[np.float32], events_per_dot: NDArray[np.integer]) -> NDArray[np.float32]:
        """Slip probability of every slice of a trajectory (slices, dots); NaN until the history is full."""
        history = self.architecture.history
        probability = np.full(len(displacement_px), np.nan, np.float32)
        for first in range(history - 1, len(displacement_px), BATCH):
            at = np.arange(first, min(first + BATCH, len(displacement_px)))
            probability[at] = self.probability(features.windows(displacement_px, events_per_dot, history, at))
        return probability
