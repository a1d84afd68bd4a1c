"""The JSON report of a run: what became of every node, for programs to read.

::

    {"report": "nodegraph-report/1",
     "run": {"graph": ..., "start": ISO 8601, "seconds": ..., "exit_status": ..., "device": {...} or null,
             "versions": {...}, "files": {"written": [...], "kept": [...]}, ...},
     "nodes": [{"id": ..., "type": ..., "version": ..., "status": ..., "reason": ..., "seconds": ..., "peak_bytes": ...,
                "outputs": [{"name", "type", "shape", "dtype", "bytes", "digest"}], "error": ...}, ...]}

What is not known is null: the shape of a value without an array, the peak of a node that was not computed.
"""

from __future__ import annotations

import ast
import json
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nodegraph import __version__
from nodegraph.events import NodeRun, OutputInfo

if TYPE_CHECKING:
    from nodegraph.graph import Graph
    from nodegraph.opencl import Device
    from nodegraph.run import Result

FORMAT = "nodegraph-report/1"


def build(graph: Graph, result: Result, *, exit_status: int) -> dict[str, Any]:
    """Return the report of a run as JSON data."""
    plan = result.plan
    run = {
        "graph": str(graph.path) if graph.path else graph.name,
        "title": graph.title,
        "start": datetime.fromtimestamp(result.started, UTC).isoformat(),
        "seconds": round(result.seconds, 6),
        "exit_status": exit_status,
        "cancelled": result.cancelled,
        "targets": [_target(result, step, output) for step, output in plan.targets],
        "device": _device(plan.device),
        "cache": str(plan.cache.folder) if plan.cache.folder else None,
        "versions": _versions(),
        "files": {"written": list(map(str, result.files_written)), "kept": list(map(str, result.files_kept))},
    }
    return {"report": FORMAT, "run": run, "nodes": [_node(item) for item in result.nodes.values()]}


def write(path: Path, report: dict[str, Any]) -> None:
    """Write a report whole or not at all.  Raises OSError where it cannot be written."""
    from nodegraph.atomic import write_atomically

    write_atomically(path, (json.dumps(report, indent=1, ensure_ascii=False) + "\n").encode())


def _target(result: Result, index: int, output: int) -> str:
    step = result.plan.network.steps[index]
    return f"{step.id}.{step.node.outputs[output].name}"


def _node(run: NodeRun) -> dict[str, Any]:
    return {
        "id": run.id,
        "type": run.type,
        "version": run.version,
        "status": run.status,
        "reason": run.reason,
        "seconds": round(run.seconds, 6),
        "peak_bytes": run.peak_bytes or None,
        "outputs": [_output(item) for item in run.outputs],
        "error": run.error or None,
    }


def _output(info: OutputInfo) -> dict[str, Any]:
    shape, dtype = parse_shape(info.shape)
    return {
        "name": info.name,
        "type": info.type,
        "shape": shape,
        "dtype": dtype,
        "bytes": info.bytes,
        "digest": info.digest,
    }


def parse_shape(text: str) -> tuple[list[int] | None, str | None]:
    """Return shape and dtype from the text of `nodegraph.porttypes.shape_text`.

    >>> parse_shape("(344, 403) float32"), parse_shape("")
    (([344, 403], 'float32'), (None, None))
    """
    shape, bracket, dtype = text.rpartition(") ")
    return (list(ast.literal_eval(shape + ")")), dtype) if bracket else (None, None)


def _device(device: Device | None) -> dict[str, str] | None:
    if device is None:
        return None
    info = device.info
    return {"id": info.id, "name": info.name, "kind": info.kind, "platform": info.platform, "driver": info.driver}


def _versions() -> dict[str, str]:
    import numpy as np

    from nodegraph.plugins import registry

    plugins = {name: plugin.version for name, plugin in registry().plugins.items() if not plugin.error}
    return {"nodegraph": __version__, "python": platform.python_version(), "numpy": np.__version__, **plugins}
