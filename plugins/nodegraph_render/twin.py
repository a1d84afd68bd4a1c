"""Twins of nodes that are one function on every machine.

Pictures are followed, shaded and put together by kernels and NumPy in turns: such a node's function itself asks
`Context.device` where to compute, and takes its inputs on the host.
"""

from __future__ import annotations

from functools import wraps
from typing import Any

from nodegraph import Context, Node


def same_on_device(node: Node[..., Any], *, rtol: float, atol: float, back: bool = True) -> None:
    """Attach to a node, as its OpenCL twin, its own function.

    Args:
        node: the node; its function computes on `Context.device` where that is one.
        rtol, atol: what the rounding of the device may change, as of `Node.opencl`.
        back: bring what it gives to the device, for the nodes that follow; else it stays on the host.
    """

    @node.opencl(rtol=rtol, atol=atol)
    @wraps(node.function)
    def twin(*inputs: Any, context: Context, **parameters: Any) -> Any:
        from nodegraph.opencl import to_device, to_host

        found = node.function(*map(to_host, inputs), context=context, **parameters)
        return to_device(found, context.device) if back and context.device is not None else found
