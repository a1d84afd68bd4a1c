"""The checks of the contract kit, one function each.

Each takes a node and its examples and raises `AssertionError` with a sentence when the promise does not hold.
"""

from __future__ import annotations

import itertools
import json
import tempfile
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nodegraph import codec
from nodegraph.cache import keys
from nodegraph.cache.store import ValueStore
from nodegraph.context import Context
from nodegraph.nodetypes import Node
from nodegraph.parameters import Checked, Field, ParameterErrors
from nodegraph.porttypes import conform, field_names

AnyNode = Node[..., Any]


@dataclass(frozen=True)
class Example:
    """One way to call a node.

    Attributes:
        inputs: a value by port name; a list of values for a variadic port.  Small ones keep the checks fast; rasters
            should have sides that differ and, where the node allows them, voids.
        params: JSON values by parameter name.
    """

    inputs: Mapping[str, Any] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)


def check_node(node: AnyNode, examples: Sequence[Example]) -> None:
    """Run every check on a node.  Raises `AssertionError` at the first promise that does not hold."""
    for _, check in checks_for(node, examples):
        check()


def checks_for(node: AnyNode, examples: Sequence[Example]) -> Iterator[tuple[str, Callable[[], None]]]:
    """Yield (name, check) for every check that applies to the node."""
    for check in CHECKS:
        if check is twin_agrees and node.twin is None:
            continue
        yield check.__name__, partial(check, node, examples)


# The promises.


def documented(node: AnyNode, examples: Sequence[Example]) -> None:
    """Node, ports and parameters explain themselves: a first line, a meaning for each parameter, examples to run."""
    assert examples, f"{node.id}: give at least one Example"
    assert node.summary.rstrip().endswith((".", ":")), f"{node.id}: the docstring must start with a sentence"
    for item in node.parameters.fields.values():
        assert item.param.description, f"{node.id}: parameter '{item.name}' needs Param('one line of meaning')"
    for name, kind in [(port.name, port.type) for port in node.inputs] + [(p.name, p.type) for p in node.outputs]:
        assert kind.__doc__, f"{node.id}: the type of port '{name}' has no docstring"


def parameters_sound(node: AnyNode, examples: Sequence[Example]) -> None:
    """The defaults are valid, the schema can be made, and JSON survives: checking canonical values changes nothing."""
    schema = node.parameters.json_schema()
    assert set(schema.get("properties", {})) == set(node.parameters.fields), f"{node.id}: the schema misses parameters"
    json.dumps(schema, allow_nan=False)
    required = {item.name for item in node.parameters.fields.values() if item.required}
    for example in (*examples, *([] if required else [Example()])):
        assert required <= set(example.params), f"{node.id}: an Example must give {sorted(required)}"
        checked = node.parameters.check(example.params)
        again = node.parameters.check({**json.loads(checked.canonical), **_files(node, example)})
        assert again.canonical == checked.canonical, (
            f"{node.id}: the parameters do not survive a round trip through JSON"
        )


def keys_tell_apart(node: AnyNode, examples: Sequence[Example]) -> None:
    """Another value of any parameter, or of any input, gives another cache key."""
    for example in examples:
        inputs = [(port, codec.seal(value)) for port, value in _pairs(node, example)]
        checked = node.parameters.check(example.params)
        base = keys.key(b"", checked.canonical, inputs)
        for position, (port, _) in enumerate(inputs):
            changed = [*inputs[:position], (port, b"another digest.."), *inputs[position + 1 :]]
            assert keys.key(b"", checked.canonical, changed) != base, f"{node.id}: input '{port}' is not in the key"
    for item in node.parameters.fields.values():
        if item.input_file is not None:
            continue
        pair = _two_values(node, item, examples)
        assert pair is not None, f"{node.id}: no second valid value of '{item.name}' found; give Examples with two"
        assert pair[0].canonical != pair[1].canonical, f"{node.id}: parameter '{item.name}' is not in the key"


def outputs_conform(node: AnyNode, examples: Sequence[Example]) -> None:
    """What the node returns is of the declared types, and the plain function gives the same as the engine."""
    for example in examples:
        values = _run(node, example)
        positional = [value for _, value in _pairs(node, example)] if not _has_gap(node, example) else None
        if positional is not None:
            plain = node(*positional, **node.parameters.check(example.params).values)
            plain = tuple(plain) if len(node.outputs) > 1 else (plain,)
            for port, engine, own in zip(node.outputs, values, plain, strict=True):
                same = codec.seal(conform(own, port.type)) == codec.seal(engine)
                assert same, f"{node.id}: a plain call gives another '{port.name}' than the engine"


def inputs_unmutated(node: AnyNode, examples: Sequence[Example]) -> None:
    """The node leaves its inputs as they were."""
    for example in examples:
        before = [codec.seal(value) for _, value in _pairs(node, example)]
        _run(node, example)
        after = [codec.seal(value) for _, value in _pairs(node, example)]
        assert before == after, f"{node.id}: an input was changed"


def deterministic(node: AnyNode, examples: Sequence[Example]) -> None:
    """Computing twice gives the same bytes."""
    for example in examples:
        first, second = ([codec.seal(value) for value in _run(node, example)] for _ in range(2))
        assert first == second, f"{node.id}: the same call gave two different values"


def values_encode(node: AnyNode, examples: Sequence[Example]) -> None:
    """The outputs survive the cache: what is read back is equal, and read-only."""
    with tempfile.TemporaryDirectory() as folder:
        store = ValueStore(Path(folder))
        for value in itertools.chain.from_iterable(_run(node, example) for example in examples):
            digest = codec.seal(value)
            store.write(digest, value)
            back = store.read(digest)
            assert type(back) is type(value), f"{node.id}: an output comes back from the cache as another type"
            assert codec.seal(back) == digest, f"{node.id}: an output comes back from the cache with other contents"
            assert not any(array.flags.writeable for array in _arrays(back) if array.ndim), (
                f"{node.id}: a cached array is writable"
            )


def locality_holds(node: AnyNode, examples: Sequence[Example]) -> None:
    """A crop computed with its halo equals the crop of the whole, in the interior and at every border."""
    for example in examples:
        rasters = {port: value for port, value in _pairs(node, example) if _is_raster(value)}
        values = [value for value in _run(node, example) if _is_raster(value)]
        if not rasters or not values:
            continue
        assert node.locality is not None, f"{node.id}: a raster node declares its locality (pointwise, halo or whole)"
        if node.locality.kind == "whole":
            continue
        shape = values[0].shape
        same = all(value.shape == shape for value in (*rasters.values(), *values))
        assert same, f"{node.id}: a node whose output has another shape than its inputs has the locality 'whole'"
        params = node.parameters.check(example.params).values
        cell_size = getattr(next(iter(rasters.values())), "cell_size", (1.0,))[0]
        reach = node.locality.cells(params, cell_size) or 0
        for rows, cols in _windows(shape):
            wide = tuple(
                slice(max(part.start - reach, 0), min(part.stop + reach, side))
                for part, side in zip((rows, cols), shape, strict=True)
            )
            cropped = _map(example.inputs, partial(_crop, window=wide))
            part = [value for value in _run(node, Example(cropped, example.params)) if _is_raster(value)]
            inner = tuple(
                slice(part_.start - wide_.start, part_.stop - wide_.start)
                for part_, wide_ in zip((rows, cols), wide, strict=True)
            )
            for whole_value, part_value in zip(values, part, strict=True):
                expected, given = whole_value.window(rows, cols).data, part_value.window(*inner).data
                message = f"{node.id}: a crop with a halo of {reach} cells differs from the whole, by {{}}"
                _assert_close(given, expected, 1e-6, 0.0, message)


def twin_agrees(node: AnyNode, examples: Sequence[Example]) -> None:
    """The OpenCL twin gives the same as the host implementation, within the tolerance that the author declared."""
    from nodegraph.opencl import choose, is_on_device, to_device, to_host

    device = choose("auto")
    assert device is not None, f"{node.id}: no OpenCL device to run the twin on; install pyopencl[pocl]"
    assert node.twin is not None
    for example in examples:
        expected = _run(node, example)
        linked = {
            port: [to_device(value, device) for value in values] for port, values in _linked(node, example).items()
        }
        context = Context(type_id=node.id, device=device, seed=_seed(example))
        given = node.run(linked, node.parameters.check(example.params).values, context, twin=True)
        for port, own, other in zip(node.outputs, given, expected, strict=True):
            host = to_host(own)
            assert type(host) is type(other), f"{node.id}: the twin's '{port.name}' has another type"
            assert not is_on_device(host)
            ours, theirs = _arrays(host), _arrays(other)
            assert len(ours) == len(theirs), f"{node.id}: the twin's '{port.name}' has another structure"
            for a, b in zip(ours, theirs, strict=True):
                message = f"{node.id}: the twin's '{port.name}' differs from the host's by {{}}"
                _assert_close(a, b, node.twin.rtol, node.twin.atol, message)


CHECKS: tuple[Callable[[AnyNode, Sequence[Example]], None], ...] = (
    documented,
    parameters_sound,
    keys_tell_apart,
    outputs_conform,
    inputs_unmutated,
    deterministic,
    values_encode,
    locality_holds,
    twin_agrees,
)
"""Every check, in the order they run."""


# Calling a node.


def _linked(node: AnyNode, example: Example) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for port in node.inputs:
        if port.name in example.inputs:
            value = example.inputs[port.name]
            found[port.name] = list(value) if port.variadic else [value]
    unknown = set(example.inputs) - {port.name for port in node.inputs}
    assert not unknown, f"{node.id}: the Example names inputs that do not exist: {sorted(unknown)}"
    return found


def _pairs(node: AnyNode, example: Example) -> list[tuple[str, Any]]:
    return [(port, value) for port, values in _linked(node, example).items() for value in values]


def _has_gap(node: AnyNode, example: Example) -> bool:
    """Say whether an optional input before a linked one is left open, so that positions do not match."""
    linked = [port.name in example.inputs for port in node.inputs]
    return linked != sorted(linked, reverse=True)


def _run(node: AnyNode, example: Example) -> tuple[Any, ...]:
    for _, value in _pairs(node, example):
        codec.seal(value)
    context = Context(type_id=node.id, seed=_seed(example))
    values = node.run(_linked(node, example), node.parameters.check(example.params).values, context)
    for value in values:
        codec.seal(value)
    return values


def _seed(example: Example) -> int:
    seed = example.params.get("seed", 0)
    return seed if isinstance(seed, int) else 0


# Second values of parameters.


def _two_values(node: AnyNode, item: Field, examples: Sequence[Example]) -> tuple[Checked, Checked] | None:
    for example in examples:
        first = node.parameters.check(example.params)
        others = [other.params[item.name] for other in examples if item.name in other.params]
        for candidate in (*_candidates(item.annotation, first.values[item.name]), *others):
            try:
                second = node.parameters.check({**example.params, item.name: candidate})
            except ParameterErrors:
                continue
            if second.values[item.name] != first.values[item.name]:
                return first, second
    return None


def _candidates(annotation: Any, value: Any) -> Iterator[Any]:
    """Yield JSON values that another value of this annotation might be."""
    for part in (annotation, *typing.get_args(annotation)):
        if typing.get_origin(part) is typing.Literal:
            yield from typing.get_args(part)
        elif part is bool:
            yield not value
        elif part in (int, float):
            base = value if isinstance(value, (int, float)) and not isinstance(value, bool) else 1
            yield from (base + 1, base - 1, base * 2, base / 2, 0, 1, 0.5, 2, 45, 100)
        elif part is str:
            yield from ("another", "#102030")
        elif part is type(None):
            yield None
        elif typing.get_origin(part) in (list, tuple) and isinstance(value, (list, tuple)) and value:
            items = json.loads(json.dumps(value, default=str))
            yield from (items[:-1], [*items, items[-1]], items[::-1])
            if isinstance(items[0], (int, float)):
                yield [item + 1 for item in items]


def _files(node: AnyNode, example: Example) -> dict[str, Any]:
    # The canonical form holds only the names of files to read; the call needs their paths.
    return {item.name: example.params[item.name] for item in node.parameters.input_files if item.name in example.params}


# Rasters and arrays.


def _is_raster(value: Any) -> bool:
    return hasattr(value, "window") and hasattr(value, "shape")


def _crop(value: Any, window: Sequence[slice]) -> Any:
    return value.window(*window) if _is_raster(value) else value


def _windows(shape: tuple[int, int]) -> list[tuple[slice, ...]]:
    """Return windows in the interior, at every border and of a single cell."""
    thirds = [sorted({0, side // 3, 2 * side // 3, side}) for side in shape]
    parts = [[slice(a, b) for a, b in itertools.pairwise(marks)] for marks in thirds]
    return [
        *itertools.product(*parts),
        (slice(shape[0] // 2, shape[0] // 2 + 1), slice(shape[1] // 2, shape[1] // 2 + 1)),
    ]


def _map(inputs: Mapping[str, Any], change: Callable[[Any], Any]) -> dict[str, Any]:
    return {
        port: [change(item) for item in value] if isinstance(value, list) else change(value)
        for port, value in inputs.items()
    }


def _arrays(value: Any) -> list[Any]:
    """Return the arrays of a value, and its numbers as arrays, in the order of the fields."""
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, float):
        return [np.asarray(value)]
    parts = value if isinstance(value, tuple) else [getattr(value, name) for name in field_names(type(value)) or ()]
    return [array for part in parts for array in _arrays(part)]


def _assert_close(given: Any, expected: Any, rtol: float, atol: float, message: str) -> None:
    assert given.shape == expected.shape, message.format(f"shape {given.shape}, not {expected.shape}")
    if expected.size == 0 or not np.issubdtype(expected.dtype, np.number):
        assert np.array_equal(given, expected), message.format("its contents")
        return
    a, b = np.asarray(given, np.float64), np.asarray(expected, np.float64)
    assert np.array_equal(np.isnan(a), np.isnan(b)), message.format("where it is void")
    finite = np.isfinite(a) & np.isfinite(b)
    assert np.array_equal(a[~finite & ~np.isnan(a)], b[~finite & ~np.isnan(b)]), message.format("infinite cells")
    if not finite.any():
        return
    allowed = atol + rtol * max(float(np.ptp(b[finite])), float(np.abs(b[finite]).max()) * 1e-6)
    worst = float(np.abs(a[finite] - b[finite]).max())
    assert worst <= allowed, message.format(f"{worst:g}, allowed {allowed:g}")
