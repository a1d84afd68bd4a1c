"""nodegraph: a dataflow engine whose nodes are typed functions.

The names below are the public interface; each is loaded from its module when it is first used, so that a command that
needs little imports little.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nodegraph.context import Context as Context
    from nodegraph.errors import Cancelled as Cancelled
    from nodegraph.errors import GraphError as GraphError
    from nodegraph.errors import NodeError as NodeError
    from nodegraph.errors import NodegraphError as NodegraphError
    from nodegraph.errors import RunError as RunError
    from nodegraph.files import File as File
    from nodegraph.formats import Format as Format
    from nodegraph.graph import Graph as Graph
    from nodegraph.nodetypes import Forecast as Forecast
    from nodegraph.nodetypes import Node as Node
    from nodegraph.nodetypes import halo as halo
    from nodegraph.nodetypes import node as node
    from nodegraph.nodetypes import pointwise as pointwise
    from nodegraph.nodetypes import whole as whole
    from nodegraph.parameters import InputFile as InputFile
    from nodegraph.parameters import InputPath as InputPath
    from nodegraph.parameters import OutputFile as OutputFile
    from nodegraph.parameters import OutputName as OutputName
    from nodegraph.parameters import Param as Param
    from nodegraph.plugins import Family as Family
    from nodegraph.plugins import Migration as Migration
    from nodegraph.plugins import Preview as Preview
    from nodegraph.plugins import hookimpl as hookimpl
    from nodegraph.porttypes import port_type as port_type

__version__ = "0.1.0"

_HOME = {
    "context": ("Context",),
    "errors": ("Cancelled", "GraphError", "NodeError", "NodegraphError", "RunError"),
    "files": ("File",),
    "formats": ("Format",),
    "graph": ("Graph",),
    "nodetypes": ("Forecast", "Node", "halo", "node", "pointwise", "whole"),
    "parameters": ("InputFile", "InputPath", "OutputFile", "OutputName", "Param"),
    "plugins": ("Family", "Migration", "Preview", "hookimpl"),
    "porttypes": ("port_type",),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'nodegraph' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"nodegraph.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF})
