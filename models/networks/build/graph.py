"""A few lines over onnx.helper: every call appends a node and returns the name of its output."""

import numpy as np
from onnx import TensorProto, helper, numpy_helper


class Graph:
    def __init__(self):
        self.nodes, self.initializers, self.count = [], [], 0

    def fresh(self, hint):
        self.count += 1
        return f"{hint}_{self.count}"

    def op(self, kind, *inputs, outputs=1, **attributes):
        names = [self.fresh(kind.lower()) for _ in range(outputs)]
        inputs = [i if isinstance(i, str) else self.const(i) for i in inputs]
        self.nodes.append(helper.make_node(kind, inputs, names, **attributes))
        return names[0] if outputs == 1 else names

    def const(self, value):
        value = np.asarray(value)
        if value.dtype == np.float64:
            value = value.astype(np.float32)
        name = self.fresh("c")
        self.initializers.append(numpy_helper.from_array(value, name))
        return name

    # Arithmetic.
    def add(self, a, b): return self.op("Add", a, b)
    def sub(self, a, b): return self.op("Sub", a, b)
    def mul(self, a, b): return self.op("Mul", a, b)
    def div(self, a, b): return self.op("Div", a, b)
    def matmul(self, a, b): return self.op("MatMul", a, b)
    def reshape(self, a, shape): return self.op("Reshape", a, shape if isinstance(shape, str) else np.array(shape, np.int64))
    def concat(self, *parts, axis=0): return self.op("Concat", *parts, axis=axis)
    def cast(self, a, to): return self.op("Cast", a, to=to)
    def clip(self, a, lo, hi): return self.op("Clip", a, np.float32(lo), np.float32(hi))
    def pick(self, a, index, axis=0): return self.op("Gather", a, np.array(index, np.int64), axis=axis)
    def unsqueeze(self, a, *axes): return self.op("Unsqueeze", a, np.array(axes, np.int64))

    def total(self, a, axis, keep=1):
        return self.op("ReduceSum", a, np.array([axis], np.int64), keepdims=keep)

    def maximum(self, a, axis, keep=1):
        return self.op("ReduceMax", a, axes=[axis], keepdims=keep)

    def arange(self, n):
        """0, 1, … n−1 as floats; n is an int64 scalar."""
        return self.cast(self.op("Range", np.int64(0), n, np.int64(1)), TensorProto.FLOAT)

    def model(self, name, inputs, outputs, doc):
        value = lambda n, s: helper.make_tensor_value_info(n, TensorProto.FLOAT, s)
        graph = helper.make_graph(
            self.nodes, name, [value(*i) for i in inputs], [value(*o) for o in outputs], self.initializers)
        return helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, producer_name="dgtr", doc_string=doc)
