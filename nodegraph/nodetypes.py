"""Declaring a node: a typed function becomes a node type.

>>> import numpy as np
>>> from typing import Annotated
>>> from nodegraph import Param, node
>>> @node(version=1)
... def scale(values: np.ndarray, *, factor: Annotated[float, Param("What to multiply by.", ge=0)] = 2.0) -> np.ndarray:
...     '''Multiply an array by a number.'''
...     return values * factor
>>> scale(np.arange(3.0))
array([0., 2., 4.])
>>> [port.name for port in scale.inputs], scale.parameters.fields["factor"].default
(['values'], 2.0)

Positional parameters are input ports (``X | None = None`` is optional, ``*xs: X`` variadic), keyword-only parameters
are the node's parameters, and the return annotation gives the outputs: one port named ``out``, or the fields of a
``NamedTuple``.  A keyword parameter annotated `Context` is the engine's.  A node may be generic: with
``T = TypeVar("T", bound=Raster)``, ``def clamp(raster: T, ...) -> T`` gives an elevation for an elevation.
"""

from __future__ import annotations

import copy
import functools
import inspect
import time
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

from nodegraph.context import Context
from nodegraph.errors import PluginError
from nodegraph.parameters import REQUIRED, ParameterSet
from nodegraph.porttypes import conform, describe, is_port_type

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

BEGAN = time.time()
"""When this process began to load nodes, seconds since the epoch."""

_IMMUTABLE = frozenset({bool, int, float, str, bytes, type(None), type(Path())})


@dataclass(frozen=True, slots=True)
class InputPort:
    """An input of a node: `optional` may stay unlinked (the function gets None), `variadic` takes any number.

    `variable` names the type variable of a generic port; `type` is then its bound.
    """

    name: str
    type: type
    optional: bool = False
    variadic: bool = False
    variable: str = ""


@dataclass(frozen=True, slots=True)
class OutputPort:
    """An output of a node.  With a `variable` it has the type of whatever is linked to the input of that variable."""

    name: str
    type: type
    variable: str = ""


@dataclass(frozen=True, slots=True)
class Locality:
    """How far around a cell of its output a raster node looks in its inputs.

    ``kind`` is ``pointwise`` (the cell itself), ``halo`` (up to ``reach(params)`` away) or ``whole`` (anything).
    The contract kit proves it: a crop computed with its halo equals the crop of the whole.
    """

    kind: typing.Literal["pointwise", "halo", "whole"]
    reach: Callable[..., float] | None = None
    unit: typing.Literal["cells", "m"] = "cells"

    def cells(self, params: Mapping[str, Any], cell_size: float) -> int | None:
        """Return the halo in cells for these parameters on cells of `cell_size` metres; None for ``whole``."""
        if self.kind == "whole":
            return None
        if self.reach is None:
            return 0
        distance = self.reach(**params)
        return int(-(-distance // (cell_size if self.unit == "m" else 1.0)))


pointwise = Locality("pointwise")
whole = Locality("whole")


def halo(*, cells: int | Callable[..., float] | None = None, metres: Callable[..., float] | None = None) -> Locality:
    """Declare a neighbourhood: a number of cells, or a function of the node's parameters giving cells or metres.

    The function gets the parameters by name: ``halo(metres=lambda sigma, **_: 4 * sigma)``.
    """
    if (cells is None) == (metres is None):
        raise PluginError("halo: give either cells or metres")
    if metres is not None:
        return Locality("halo", metres, "m")
    if isinstance(cells, int):
        return Locality("halo", lambda **_: cells)
    return Locality("halo", cells)


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a value will weigh, known before it is computed.

    Attributes:
        bytes: size of the value.
        peak: what computing it takes beyond its inputs and itself.
        about: whatever the plugin wants to hand to the forecasts downstream (a raster's shape and cell size, say).
        known: False where only computing tells; `bytes` and `peak` are then the least.
    """

    bytes: int
    peak: int = 0
    about: Any = None
    known: bool = True


@dataclass(frozen=True, slots=True)
class Twin:
    """A second implementation of a node on OpenCL, and how closely it agrees with the first."""

    function: Callable[..., Any]
    rtol: float
    atol: float


class Node(Generic[P, R]):
    """A node type.  Still an ordinary callable: ``node(...)`` runs the function without any engine.

    Attributes:
        function: the decorated function.
        version: raised by the author when the node's meaning changes; part of every cache key.
        locality: how far a raster node looks, or None for nodes without rasters.
        family: set when a plugin registers the node; with it the type id is ``family.name``.
        twin: the OpenCL implementation, if any.
    """

    def __init__(self, function: Callable[P, R], version: int, locality: Locality | None, title: str | None) -> None:
        functools.update_wrapper(self, function)
        self.function = function
        self.name: str = function.__name__
        self.version = version
        self.locality = locality
        self.family = "local"
        self.twin: Twin | None = None
        self.declared_at = time.time()
        self._title = title
        self._forecast: Callable[..., Forecast] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the function itself; a parameter annotated `Context` gets an inert one unless it is given."""
        name = self.context_parameter
        if name is not None and name not in kwargs:
            # The same dice as in a run, so that a plain call gives what the engine gives.
            declared = self.parameters.fields.get("seed")
            seed = kwargs.get("seed", declared.default if declared is not None else 0)
            kwargs[name] = Context(dice=self.name, seed=seed)
        return self.function(*args, **kwargs)

    def __repr__(self) -> str:
        return f"<node {self.id} v{self.version}>"

    # What the declaration says.

    @property
    def id(self) -> str:
        """The type id, ``family.name``, as graph files name it."""
        return f"{self.family}.{self.name}"

    @property
    def title(self) -> str:
        """The name a person reads: the given title, or the function's name in words."""
        return self._title or self.name.replace("_", " ").capitalize()

    @property
    def category(self) -> str:
        """Where a menu puts the node: the last part of its module's name."""
        return self.function.__module__.rsplit(".", 1)[-1].replace("_", " ")

    @property
    def help(self) -> str:
        """The whole docstring."""
        return inspect.getdoc(self.function) or ""

    @property
    def summary(self) -> str:
        """The docstring's first line."""
        return self.help.split("\n", 1)[0]

    @property
    def inputs(self) -> tuple[InputPort, ...]:
        """The input ports in order; a variadic one comes last."""
        return self._declared.inputs

    @property
    def outputs(self) -> tuple[OutputPort, ...]:
        """The output ports in order."""
        return self._declared.outputs

    @property
    def parameters(self) -> ParameterSet:
        """The parameters."""
        return self._declared.parameters

    @property
    def context_parameter(self) -> str | None:
        """The name of the parameter annotated `Context`, if there is one."""
        return self._declared.context

    def input(self, name: str) -> InputPort | None:
        """Return the input port of that name, or None."""
        return self._declared.input_by_name.get(name)

    def output_index(self, name: str) -> int | None:
        """Return the position of the output port of that name, or None."""
        return self._declared.output_by_name.get(name)

    @cached_property
    def _declared(self) -> _Declared:
        return _declared(self)

    # What authors attach.

    def opencl(self, *, rtol: float = 1e-5, atol: float = 0.0) -> Callable[[F], F]:
        """Attach an OpenCL twin: a function of the same signature whose rasters hold device arrays.

        Args:
            rtol: largest difference to the host implementation that the contract kit accepts, relative to the range
                of the host's values.
            atol: the same, absolute, in the output's unit.
        """

        def attach(function: F) -> F:
            own, other = inspect.signature(self.function).parameters, inspect.signature(function).parameters
            context = {self.context_parameter, *(n for n, p in other.items() if "Context" in str(p.annotation))}
            if [n for n in own if n not in context] != [n for n in other if n not in context]:
                raise PluginError(f"node '{self.id}': its OpenCL twin must take the same parameters")
            self.twin = Twin(function, rtol, atol)
            return function

        return attach

    def forecast(self, function: Callable[..., Forecast]) -> Callable[..., Forecast]:
        """Attach a memory forecast: it gets the inputs' `Forecast`s by position and the parameters by name.

        It must be quick: it may read the header of a file, never its data.
        """
        self._forecast = function
        return function

    @property
    def forecasts(self) -> bool:
        """True where the author attached a memory forecast."""
        return self._forecast is not None

    # What the engine calls.

    def predict(self, inputs: Mapping[str, Sequence[Forecast]], params: Mapping[str, Any]) -> Forecast:
        """Return the forecast of this node's outputs together; without an author's own, as large as its inputs."""
        given = [item for items in inputs.values() for item in items]
        if self._forecast is not None:
            return self._forecast(*self._arguments({k: list(v) for k, v in inputs.items()}), **params)
        largest = max(given, key=lambda item: item.bytes, default=Forecast(0))
        count = sum(1 for port in self.outputs if port.type not in (bool, int, float, str))
        return Forecast(largest.bytes * count, largest.bytes, largest.about)

    def run(
        self, inputs: Mapping[str, Sequence[Any]], params: Mapping[str, Any], context: Context, *, twin: bool = False
    ) -> tuple[Any, ...]:
        """Call the implementation and return its outputs in order, each checked against its port type.

        Args:
            inputs: the linked values by port name, one each (any number for a variadic port).
            params: validated parameters by name.
            context: what the node may ask of the engine.
            twin: run the OpenCL implementation (the values then hold device arrays).

        Raises:
            TypeError: the node returned something else than it declares.
        """
        declared = self._declared
        function: Callable[..., Any] = self.function
        name = declared.context
        if twin:
            if self.twin is None:
                raise PluginError(f"node '{self.id}' has no OpenCL twin")
            function, name = self.twin.function, _context_name(self.twin.function) or name
        if not all(type(value) in _IMMUTABLE for value in params.values()):
            params = copy.deepcopy(dict(params))  # the engine calls again with these: a node may not change them
        if name is not None:
            params = {**params, name: context}
        result = function(*self._arguments(inputs), **params)
        if declared.named_tuple is None:
            return (self._conform(result, declared.outputs[0]),)
        if not isinstance(result, declared.named_tuple):
            raise TypeError(f"returned {type(result).__name__}, expected {declared.named_tuple.__name__}")
        return tuple([self._conform(item, port) for item, port in zip(result, declared.outputs, strict=True)])

    def _arguments(self, inputs: Mapping[str, Sequence[Any]]) -> list[Any]:
        arguments: list[Any] = []
        for port in self._declared.inputs:
            linked = inputs.get(port.name, ())
            if port.variadic:
                arguments.extend(linked)
            else:
                arguments.append(linked[0] if linked else None)
        return arguments

    def _conform(self, value: Any, port: OutputPort) -> Any:
        try:
            return conform(value, port.type)
        except TypeError as error:
            raise TypeError(f"output '{port.name}': {error}") from None


def node(
    *, version: int, locality: Locality | None = None, title: str | None = None
) -> Callable[[Callable[P, R]], Node[P, R]]:
    """Make a function a node type.

    Args:
        version: 1 at first; raise it when the same parameters and inputs come to mean something else.
        locality: `pointwise`, `halo(...)` or `whole`; raster nodes declare it.
        title: what a person reads, where the function's name in words will not do.
    """

    def declare(function: Callable[P, R]) -> Node[P, R]:
        return Node(function, version, locality, title)

    return declare


@dataclass(frozen=True, slots=True)
class _Declared:
    """A node's signature, read once."""

    inputs: tuple[InputPort, ...]
    outputs: tuple[OutputPort, ...]
    parameters: ParameterSet
    context: str | None
    named_tuple: type[tuple[Any, ...]] | None
    input_by_name: dict[str, InputPort]
    output_by_name: dict[str, int]


def _declared(declaring: Node[..., Any]) -> _Declared:
    where = f"node '{declaring.name}' ({declaring.function.__module__})"
    try:
        hints = typing.get_type_hints(declaring.function, include_extras=True)
    except NameError as error:
        raise PluginError(f"{where}: an annotation cannot be resolved ({error})") from error
    inputs: list[InputPort] = []
    params: dict[str, tuple[Any, Any]] = {}
    context = None
    for name, item in inspect.signature(declaring.function).parameters.items():
        if name not in hints:
            raise PluginError(f"{where}: parameter '{name}' needs a type annotation")
        if hints[name] is Context:
            context = name
        elif item.kind is item.KEYWORD_ONLY:
            params[name] = (hints[name], REQUIRED if item.default is item.empty else item.default)
        elif item.kind is item.VAR_KEYWORD:
            raise PluginError(f"{where}: '**{name}' is not allowed; name the parameters")
        else:
            inputs.append(_input_port(where, item, hints[name]))
    if clash := {port.name for port in inputs} & set(params):
        raise PluginError(f"{where}: '{clash.pop()}' names both a port and a parameter")
    outputs, named_tuple = _outputs(where, hints.get("return"))
    return _Declared(
        tuple(inputs),
        outputs,
        ParameterSet(declaring.name, params),
        context,
        named_tuple,
        {port.name: port for port in inputs},
        {port.name: position for position, port in enumerate(outputs)},
    )


def _input_port(where: str, item: inspect.Parameter, hint: Any) -> InputPort:
    optional = False
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        rest = [part for part in typing.get_args(hint) if part is not type(None)]
        optional = len(rest) < len(typing.get_args(hint))
        hint = rest[0] if len(rest) == 1 else hint
    variable = _variable(hint)
    hint = _plain(hint)
    if not is_port_type(hint):
        raise PluginError(
            f"{where}: input '{item.name}' has type {hint}, which is no port type (declare it: @port_type)"
        )
    if optional != (item.default is None):
        raise PluginError(f"{where}: optional input '{item.name}' must read '{describe(hint)} | None = None'")
    if item.default is not item.empty and item.default is not None:
        raise PluginError(f"{where}: input '{item.name}' may have no default; make it keyword-only to be a parameter")
    return InputPort(item.name, hint, optional, item.kind is item.VAR_POSITIONAL, variable)


def _outputs(where: str, hint: Any) -> tuple[tuple[OutputPort, ...], type[tuple[Any, ...]] | None]:
    variable = _variable(hint)
    hint = _plain(hint)
    if is_port_type(hint):
        return (OutputPort("out", hint, variable),), None
    if isinstance(hint, type) and issubclass(hint, tuple) and hasattr(hint, "_fields"):
        fields = {name: _plain(item) for name, item in typing.get_type_hints(hint).items()}
        for name, item in fields.items():
            if not is_port_type(item):
                raise PluginError(f"{where}: output '{name}' has type {item}, which is no port type")
        return tuple(OutputPort(name, item) for name, item in fields.items()), hint
    raise PluginError(f"{where}: the return annotation must be a port type or a NamedTuple of them, not {hint}")


def _variable(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, TypeVar) else ""


def _plain(hint: Any) -> Any:
    """Return the class behind an annotation: ``npt.NDArray[np.float32]`` is ``numpy.ndarray``."""
    if isinstance(hint, TypeVar):
        return hint.__bound__
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return _plain(typing.get_args(hint)[0])
    return origin if isinstance(origin, type) and origin is not types.UnionType else hint


@functools.cache
def _context_name(function: Callable[..., Any]) -> str | None:
    hints = typing.get_type_hints(function)
    return next((name for name, hint in hints.items() if hint is Context), None)
