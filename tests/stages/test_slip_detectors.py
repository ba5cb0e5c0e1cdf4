"""Model files are refused before onnxruntime sees a graph that our exporter did not write for these weights."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from evetac_cli import resources
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.stages.slip_detectors import load_detector
from evetac_cli.store.files import StageFile


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """The model that evetac comes with."""
    return Path(shutil.copy(resources.MODEL, tmp_path / "a.model.h5"))


def stored_graph(path: Path) -> Any:
    with StageFile(path, "model") as file:
        return onnx.load_model_from_string(file.read("onnx").tobytes())


def store_graph(path: Path, graph: Any) -> None:
    with h5py.File(path, "r+") as h5:
        for name in ("onnx", "checkpoint/onnx", "bytes"):  # `bytes` is their dimension
            del h5[name]
        h5["onnx"] = np.frombuffer(graph.SerializeToString(), np.uint8)


def add_to_output(graph: Any, *nodes: Any) -> None:
    """Put nodes behind the last one: they take `before` and give `probability`."""
    graph.graph.node[-1].output[0] = "before"
    graph.graph.node.extend(nodes)


def endless_loop(graph: Any) -> None:
    """A loop whose condition stays true and whose number of rounds is the largest that there is."""
    same = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch"]) for name in ("a", "b")]
    go_on = [helper.make_tensor_value_info(name, TensorProto.BOOL, []) for name in ("c", "d")]
    body = helper.make_graph(
        [helper.make_node("Identity", ["c"], ["d"]), helper.make_node("Identity", ["a"], ["b"])],
        "body",
        [helper.make_tensor_value_info("i", TensorProto.INT64, []), go_on[0], same[0]],
        [go_on[1], same[1]],
    )
    graph.graph.initializer.append(numpy_helper.from_array(np.array(2**63 - 1), "rounds"))
    graph.graph.initializer.append(numpy_helper.from_array(np.array(True), "true"))
    add_to_output(graph, helper.make_node("Loop", ["rounds", "true", "before"], ["probability"], body=body))


def another_weight(graph: Any) -> None:
    (bias,) = (one for one in graph.graph.initializer if one.name == "first.bias")
    changed = numpy_helper.to_array(bias) + 1
    bias.CopyFrom(numpy_helper.from_array(changed.astype(np.float32), "first.bias"))


def weight_in_another_file(graph: Any) -> None:
    (bias,) = (one for one in graph.graph.initializer if one.name == "first.bias")
    bias.ClearField("raw_data")
    bias.data_location = TensorProto.EXTERNAL
    bias.external_data.add(key="location", value="/etc/passwd")


def function(graph: Any) -> None:
    made = helper.make_function(
        "mine", "Same", ["a"], ["b"], [helper.make_node("Identity", ["a"], ["b"])], [helper.make_opsetid("", 17)]
    )
    graph.functions.append(made)
    graph.opset_import.append(helper.make_opsetid("mine", 1))
    add_to_output(graph, helper.make_node("Same", ["before"], ["probability"], domain="mine"))


def another_size(graph: Any) -> None:
    memory = next(node for node in graph.graph.node if node.op_type == "GRU")
    (size,) = (attribute for attribute in memory.attribute if attribute.name == "hidden_size")
    size.i = 2**31


HOSTILE: dict[str, Callable[[Any], None]] = {
    name.__name__.replace("_", " "): name
    for name in (
        endless_loop,
        another_weight,
        weight_in_another_file,
        function,
        another_size,
    )
}


@pytest.mark.parametrize(
    "change",
    HOSTILE.values(),
    ids=HOSTILE,
)
def test_m7_a_graph_that_is_not_ours_is_refused(change: Callable[[Any], None], model: Path) -> None:
    """Assert that validate and whoever loads a detector refuse the graph without running it."""
    graph = stored_graph(model)
    change(graph)
    store_graph(model, graph)
    (row,) = validate.run([model]).rows
    assert row["valid"] is False
    assert "onnx" in row["faults"]
    with StageFile(model, "model") as file, pytest.raises(InputError, match="onnx"):
        load_detector(file)


def test_m7_checkpoints_are_held_to_the_same(model: Path) -> None:
    """Assert that validate refuses a checkpoint whose graph is another network, though nothing here runs it."""
    with h5py.File(model, "r+") as h5:
        graphs = h5["checkpoint/onnx"][()]
        hostile = graphs[1].tobytes().replace(b"Sigmoid", b"Softmax")  # as long as it was
        graphs[1] = np.frombuffer(hostile, np.uint8)
        h5["checkpoint/onnx"][...] = graphs
    (row,) = validate.run([model]).rows
    assert row["valid"] is False
    assert "checkpoint/onnx" in row["faults"]


def test_the_model_that_evetac_comes_with_is_taken(model: Path) -> None:
    """Assert that our own model is valid and loads."""
    assert validate.run([model]).summary["invalid"] == 0
    with StageFile(model, "model") as file:
        assert load_detector(file).architecture.name == "load-path"
