"""Run a trained slip detector from its ONNX graph: slice by slice while grasping, or over a whole trajectory."""

from collections import deque

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from evetac_cli.kernels.sensitivity import UNKNOWN, Sensitivity
from evetac_cli.kernels.slip import features, inputs
from evetac_cli.kernels.slip.architectures import GEL_PX, Architecture, DotArchitecture, ImageArchitecture
from evetac_cli.kernels.slip.features import EventImages

BATCH_VALUES = 1 << 22  # inputs at a time, 16 MiB


class Detector:
    """A network behind onnxruntime, on one thread (faster than two for networks this small)."""

    def __init__(self, graph: bytes, architecture: Architecture) -> None:
        """Load the graph of a model file; ValueError if onnxruntime refuses it."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its own without a common, importable base
            raise ValueError(f"expected an ONNX graph, found bytes that onnxruntime refuses: {error}") from error
        self.architecture = architecture

    def probability(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Slip probability (k,) of inputs (k, ...) as made by `inputs.at`; ValueError for inputs of another shape."""
        probability: NDArray[np.float32]
        try:
            (probability,) = self._session.run(None, {"features": batch})
        except Exception as error:  # as above
            wanted = self._session.get_inputs()[0].shape
            raise ValueError(f"expected inputs {wanted}, found {batch.shape}: {error}") from error
        # onnxruntime's sigmoid is an approximation: a few logits about 18 give 1.0000001
        return np.minimum(probability, np.float32(1), out=probability)

    def over(self, series: inputs.Series, first: int = 0) -> NDArray[np.float32]:
        """Slip probability of every slice of a trajectory, NaN until the history is full.

        `first`: which slice of the trajectory the series begins with, as a detector that predicts every 5th slice
        counts from the trajectory's beginning.
        """
        architecture = self.architecture
        slices = inputs.length(series)
        probability = np.full(slices, np.nan, np.float32)
        delay = -first % architecture.every  # after a full history, until the next prediction is due
        due = np.arange(architecture.history - 1 + delay, slices, architecture.every)
        at_once = max(1, BATCH_VALUES // max(1, self._input_size(series)))
        for begin in range(0, len(due), at_once):
            ends = due[begin : begin + at_once]
            probability[ends] = self.probability(inputs.at(architecture, series, ends))
        if architecture.every > 1 and len(due):
            held = np.arange(due[0], slices)
            probability[held] = probability[held - (held - due[0]) % architecture.every]
        return probability

    def _input_size(self, series: inputs.Series) -> int:
        """Number of values of one input."""
        if isinstance(self.architecture, ImageArchitecture):
            return int(np.prod(self.architecture.input_shape))
        return 1 if isinstance(series, EventImages) else int(series.shape[1]) * self.architecture.inputs_per_dot


class Live:
    """A detector that takes one slice after the other; its probabilities are those of `Detector.over`, bit for bit."""

    def __init__(
        self,
        detector: Detector,
        rest_xy_px: NDArray[np.floating],
        window_px: tuple[int, int, int, int] | NDArray[np.int32] | None,
        sensor: Sensitivity = UNKNOWN,
    ) -> None:
        """Start before the first slice; dots at rest (n, 2) in px, and the window (x0, y0, x1, y1) or None.

        sensor: what is known of it.
        """
        self.detector = detector
        self.slices = 0
        self._probability = float("nan")
        self._window_px = window_px
        architecture = detector.architecture
        history, factors = architecture.history, features.UNSCALED
        if isinstance(architecture, DotArchitecture):
            factors = architecture.factors(sensor)
        self._dots = features.start(rest_xy_px, history, factors)
        self._newest = np.array([history - 1])
        if isinstance(architecture, DotArchitecture):
            self._views = inputs.view_table(architecture.views)
            shape = (1, len(self._dots.rest_xy_px), architecture.inputs_per_dot)
            self._batch = np.zeros(shape, np.float32)
            inputs.fill(self._dots.ring[:history], self._newest, self._views, self._batch)  # compiles or loads it now
        self._images: deque[tuple[NDArray[np.uint32], NDArray[np.int8]]] = deque(maxlen=history)
        self._blank = np.zeros(GEL_PX[::-1], np.int8)

    def step(
        self,
        dot_xy_px: NDArray[np.floating],
        events_per_dot: NDArray[np.integer],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        p: NDArray[np.uint8],
    ) -> float:
        """Slip probability after one more slice, its dots and its events; NaN until the history is full."""
        architecture = self.detector.architecture
        images = isinstance(architecture, ImageArchitecture)
        if images:
            self._images.append(features.gel_image(x, y, p, self._window_px, self._blank))
        else:
            features.step(self._dots, dot_xy_px, events_per_dot)
        self.slices += 1
        since_full = self.slices - architecture.history
        if since_full >= 0 and since_full % architecture.every == 0:
            if images:
                batch = inputs.at(architecture, self._stack(), self._newest)
            else:
                inputs.fill(features.latest(self._dots), self._newest, self._views, self._batch)
                batch = self._batch
            self._probability = float(self.detector.probability(batch)[0])
        return self._probability

    def _stack(self) -> EventImages:
        pixels, signs = zip(*self._images, strict=True)
        start = np.cumsum([0, *(len(pixel) for pixel in pixels)])
        return EventImages(start, np.concatenate(pixels), np.concatenate(signs))
