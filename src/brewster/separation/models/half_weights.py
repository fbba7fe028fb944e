"""Stores the weights of an ONNX file in half precision. Needs onnx. The script
xreflection/converter.py loads this file where brewster is not installed.
"""

from typing import Final

import numpy as np
from onnx import ModelProto, TensorProto, helper, numpy_helper

HALF_SUFFIX: Final = "_half"
"""The suffix of the names of weights in half precision."""
_MIN_HALF_SIZE: Final = 16
"""Tensors with fewer values stay float32: they are constants, such as the coefficients of the sRGB
curve.
"""


def with_half_weights(model: ModelProto) -> ModelProto:
    """Stores the weights as float16, with casts to float32 before use. Changes `model` in place and
    returns it.

    ONNX Runtime folds the casts when it loads the file, so that inference takes no extra time.
    """
    graph = model.graph
    casts = []
    for index, weight in enumerate(graph.initializer):
        values = numpy_helper.to_array(weight)
        if values.dtype == np.float32 and values.size >= _MIN_HALF_SIZE:
            half = weight.name + HALF_SUFFIX
            casts.append(helper.make_node("Cast", [half], [weight.name], to=TensorProto.FLOAT))
            graph.initializer[index].CopyFrom(
                numpy_helper.from_array(values.astype(np.float16), half)
            )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    for node in graph.node:
        del node.metadata_props[:]  # stack traces with the paths of this machine
    return model
