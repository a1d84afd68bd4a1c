"""The checks of the contract kit, one function each.

Each takes a node and its examples and raises `AssertionError` with a sentence that names the node when the promise does
not hold.  A broken promise fails one check: those that build on it raise `NotCheckedError` instead, which the pytest
plugin shows as skipped.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nodegraph import codec
from nodegraph.cache import keys
from nodegraph.cache.store import ValueStore
from nodegraph.errors import sentence
from nodegraph.porttypes import BUILTIN, conform
from nodegraph.testing.calls import AnyNode, BrokenError, Call, Example, Linked, NotCheckedError, calls, checked
from nodegraph.testing.compare import Window, difference, is_raster, leaves, widened, windows, within
from nodegraph.testing.second import two_values

__all__ = ["CHECKS", "BrokenError", "Example", "NotCheckedError", "check_node", "checks_for"]

_CROP_RTOL = 1e-6


def check_node(node: AnyNode, examples: Sequence[Example]) -> None:
    """Run every check on a node.  Raises `AssertionError` at the first promise that does not hold."""
    for _, check in checks_for(node, examples):
        try:
            check()
        except NotCheckedError as unchecked:
            raise unchecked.broken from unchecked.broken.__cause__


def checks_for(node: AnyNode, examples: Sequence[Example]) -> Iterator[tuple[str, Callable[[], None]]]:
    """Yield (name, check) for every check that applies to the node.

    A check raises `AssertionError` when its promise is broken and `NotCheckedError` when another is that it builds on.
    """
    for check in CHECKS:
        if check is twin_agrees and node.twin is None:
            continue
        yield check.__name__, partial(_check, check, node, examples)


def _check(check: Callable[..., None], node: AnyNode, examples: Sequence[Example]) -> None:
    try:
        check(node, examples)
    except BrokenError as broken:
        if broken.promise == check.__name__:
            raise
        try:
            _BY_NAME[broken.promise](node, examples)
        except AssertionError:
            raise NotCheckedError(broken) from broken
        raise  # the check whose matter it is did not see it: what comes and goes must fail here, then


# The promises.


def documented(node: AnyNode, _examples: Sequence[Example]) -> None:
    """Node, ports and parameters explain themselves: a first line, and a meaning for each parameter."""

    def promise(holds: bool, message: str) -> None:
        if not holds:
            raise BrokenError(node, "documented", message)

    promise(node.summary.rstrip().endswith((".", ":")), "the docstring must start with a sentence")
    for item in node.parameters.fields.values():
        meaning = item.param.description.strip()
        promise(bool(meaning), f"parameter '{item.name}' needs Param('one line of meaning')")
        promise("\n" not in meaning, f"the meaning of parameter '{item.name}' must be one line")
    ports = [(port.name, port.type) for port in node.inputs] + [(port.name, port.type) for port in node.outputs]
    for name, kind in ports:
        # A dataclass without a docstring gets its signature for one.
        text = kind.__doc__ or ""
        own = bool(text.strip()) and not text.startswith(f"{kind.__name__}(")
        promise(own or kind in BUILTIN.values(), f"the type of port '{name}' has no docstring")


def examples_fit(node: AnyNode, examples: Sequence[Example]) -> None:
    """There are examples, and each names what exists, gives what is required, and is of the declared types."""
    calls(node, examples)


def parameters_sound(node: AnyNode, examples: Sequence[Example]) -> None:
    """The defaults are valid, the schema can be made, and JSON survives: checking canonical values changes nothing."""

    def promise(holds: bool, message: str) -> None:
        if not holds:
            raise BrokenError(node, "parameters_sound", message)

    fields = node.parameters.fields
    found = [(call.example.params, call.checked) for call in calls(node, examples)]
    if not any(item.required for item in fields.values()):
        found.append(({}, checked(node, {})))
    try:
        schema = node.parameters.json_schema()
        json.dumps(schema, allow_nan=False)
    except Exception as error:  # pydantic, on an annotation that JSON Schema cannot say
        message = f"no JSON Schema can be made of the parameters: {sentence(error)}"
        raise BrokenError(node, "parameters_sound", message) from error
    promise(set(schema.get("properties", {})) == set(fields), "the schema misses parameters")
    for params, first in found:
        # The canonical form holds only the names of files to read; the call needs their paths.
        files = {item.name: params[item.name] for item in node.parameters.input_files if item.name in params}
        try:
            again = node.parameters.check({**json.loads(first.canonical), **files})
        except ValueError as error:
            message = f"the parameters do not survive a round trip through JSON: {sentence(error)}"
            raise BrokenError(node, "parameters_sound", message) from error
        promise(again.canonical == first.canonical, "the parameters do not survive a round trip through JSON")


def keys_tell_apart(node: AnyNode, examples: Sequence[Example]) -> None:
    """Another value of any parameter, or of any input, gives another cache key."""

    def promise(holds: bool, message: str) -> None:
        if not holds:
            raise BrokenError(node, "keys_tell_apart", message)

    found = calls(node, examples)
    for call in found:
        inputs = [(port, codec.seal(value)) for port, value in call.inputs]
        base = keys.key(b"", call.checked.canonical, inputs)
        for position, (port, _) in enumerate(inputs):
            changed = [*inputs[:position], (port, b"another digest.."), *inputs[position + 1 :]]
            promise(keys.key(b"", call.checked.canonical, changed) != base, f"input '{port}' is not in the key")
    for item in node.parameters.fields.values():
        if item.input_file is not None:
            continue
        pair = two_values(found, item)
        if pair is None:
            message = f"no second valid value of '{item.name}' found; give Examples with two"
            raise BrokenError(node, "keys_tell_apart", message)
        promise(pair[0].canonical != pair[1].canonical, f"parameter '{item.name}' is not in the key")


def outputs_conform(node: AnyNode, examples: Sequence[Example]) -> None:
    """The node runs, what it returns is of the declared types, and the plain function gives the same as the engine."""
    for call in calls(node, examples):
        engine, plain = call.run(), call.plain()
        for port, one, other in zip(node.outputs, engine, plain, strict=True):
            own = conform(other, port.type)
            if call.digests([one]) != call.digests([own]):
                raise call.broken("outputs_conform", f"a plain call gives another '{port.name}' than the engine")


def inputs_unmutated(node: AnyNode, examples: Sequence[Example]) -> None:
    """The node leaves its inputs as they were, and works on read-only arrays, as those on wires are."""
    for call in calls(node, examples):
        given = call.copies()
        call.run(given)
        port = call.changed(given)
        if port:
            raise BrokenError(node, "inputs_unmutated", f"it changes its input '{port}'; copy it first")
        try:
            call.run(call.linked)
        except BrokenError as error:
            message = "it needs arrays that it can write to; those on wires are read-only"
            raise BrokenError(node, "inputs_unmutated", message) from error.__cause__


def deterministic(node: AnyNode, examples: Sequence[Example]) -> None:
    """Computing twice gives the same bytes."""
    for call in calls(node, examples):
        if not call.repeats():
            raise BrokenError(node, "deterministic", "the same call gave two different values")


def values_encode(node: AnyNode, examples: Sequence[Example]) -> None:
    """The outputs survive the cache: what is read back is equal, and read-only."""

    def promise(holds: bool, message: str) -> None:
        if not holds:
            raise BrokenError(node, "values_encode", message)

    with tempfile.TemporaryDirectory() as folder:
        store = ValueStore(Path(folder))
        for call in calls(node, examples):
            values = call.run()
            for digest, value in zip(call.digests(values), values, strict=True):
                store.write(digest, value)
                back = store.read(digest)
                promise(type(back) is type(value), "an output comes back from the cache as another type")
                arrays = [leaf for leaf in leaves(back) if isinstance(leaf, np.ndarray) and leaf.ndim]
                promise(not any(array.flags.writeable for array in arrays), "a cached array is writable")
                promise(codec.seal(back) == digest, "an output comes back from the cache with other contents")


def locality_holds(node: AnyNode, examples: Sequence[Example]) -> None:
    """A crop computed with its halo equals the crop of the whole, in the interior and at every border."""
    found = [(call, wholes) for call in calls(node, examples) if (wholes := _rasters_of(call))]
    if not found:
        return
    if node.locality is None:
        message = "a raster node declares its locality (pointwise, halo or whole)"
        raise BrokenError(node, "locality_holds", message)
    if node.locality.kind == "whole":
        return
    tried = [_crops_agree(call, wholes) for call, wholes in found]
    if not any(tried):
        message = "no Example shows the locality: give a raster that is larger than the halo on both sides"
        raise BrokenError(node, "locality_holds", message)


def _rasters_of(call: Call) -> list[Any]:
    """Return the outputs of a call that are rasters, where inputs are, too."""
    if not any(is_raster(value) for _, value in call.inputs):
        return []
    return [value for value in call.run() if is_raster(value)]


def _crops_agree(call: Call, wholes: list[Any]) -> int:
    """Compare crops with the whole; return how many were smaller than it."""
    node, locality = call.node, call.node.locality
    assert locality is not None
    rasters = [value for _, value in call.inputs if is_raster(value)]
    shape = wholes[0].shape
    if any(value.shape != shape for value in (*rasters, *wholes)):
        message = "a node whose output has another shape than its inputs has the locality 'whole'"
        raise BrokenError(node, "locality_holds", message)
    cell_size = min(getattr(rasters[0], "cell_size", (1.0,)))
    reach = locality.cells(call.checked.values, cell_size) or 0
    tried = 0
    for window in windows(shape):
        wide = widened(window, reach, shape)
        tried += wide != (slice(0, shape[0]), slice(0, shape[1]))
        values = call.run(_cropped(call.copies(), wide), promise="locality_holds")
        parts = [value for value in values if is_raster(value)]
        for whole, part in zip(wholes, parts, strict=True):
            given, expected = part.window(*within(window, wide)).data, whole.window(*window).data
            if differs := difference(given, expected, rtol=_CROP_RTOL, atol=0.0):
                around = f"with a halo of {reach} cells" if reach else "by itself"
                raise call.broken(
                    "locality_holds",
                    f"it is declared '{locality.kind}', but a crop {around} differs from the whole ({differs})",
                )
    return tried


def _cropped(linked: Linked, window: Window) -> Linked:
    return {
        port: [value.window(*window) if is_raster(value) else value for value in values]
        for port, values in linked.items()
    }


def twin_agrees(node: AnyNode, examples: Sequence[Example]) -> None:
    """The OpenCL twin gives the same as the host implementation, within the tolerance that the author declared.

    It also leaves its inputs as they were, and computing twice gives the same bytes.
    """
    from nodegraph.opencl import choose, to_device, to_host

    device, twin = choose("auto"), node.twin
    if device is None or twin is None:
        raise BrokenError(node, "twin_agrees", "no OpenCL device to run the twin on; install pyopencl[pocl]")

    def promise(holds: bool, message: str) -> None:
        if not holds:
            raise BrokenError(node, "twin_agrees", message)

    for call in calls(node, examples):
        linked = {port: [to_device(value, device) for value in values] for port, values in call.copies().items()}
        first, second = (
            [to_host(value) for value in call.run(linked, device=device, promise="twin_agrees")] for _ in range(2)
        )
        back = {port: [to_host(value) for value in values] for port, values in linked.items()}
        port_name = call.changed(back)
        promise(not port_name, f"the twin changes its input '{port_name}'; write to an array of its own")
        promise(call.digests(first) == call.digests(second), "the twin gave two different values for the same call")
        for port, own, expected in zip(node.outputs, first, call.run(), strict=True):
            same_type = f"the twin's '{port.name}' has another type, {type(own).__name__}"
            promise(type(own) is type(expected), same_type)
            ours, theirs = list(leaves(own)), list(leaves(expected))
            promise(len(ours) == len(theirs), f"the twin's '{port.name}' has another structure")
            for a, b in zip(ours, theirs, strict=True):
                if differs := difference(a, b, rtol=twin.rtol, atol=twin.atol):
                    message = f"the twin's '{port.name}' differs from the host's ({differs})"
                    raise call.broken("twin_agrees", message)


CHECKS: tuple[Callable[[AnyNode, Sequence[Example]], None], ...] = (
    documented,
    examples_fit,
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

_BY_NAME: Mapping[str, Callable[[AnyNode, Sequence[Example]], None]] = {check.__name__: check for check in CHECKS}
