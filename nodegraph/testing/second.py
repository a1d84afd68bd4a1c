"""Finding a second valid value of a parameter: what shows that the parameter reaches the cache key."""

from __future__ import annotations

import enum
import json
import typing
from collections.abc import Iterator, Sequence
from typing import Any

from nodegraph.parameters import Checked, Field, ParameterErrors
from nodegraph.testing.calls import Call


def two_values(calls: Sequence[Call], item: Field) -> tuple[Checked, Checked] | None:
    """Return two sets of valid parameters that differ in `item` only, or None where no second value was found."""
    for call in calls:
        params, first = call.example.params, call.checked
        others = [other.example.params[item.name] for other in calls if item.name in other.example.params]
        for candidate in (*_candidates(item.annotation, first.values[item.name]), *others):
            try:
                second = call.node.parameters.check({**params, item.name: candidate})
            except ParameterErrors:
                continue
            if second.values[item.name] != first.values[item.name]:
                return first, second
    return None


def _candidates(annotation: Any, value: Any) -> Iterator[Any]:
    """Yield JSON values that another value of this annotation might be."""
    for part in (annotation, *typing.get_args(annotation)):
        origin = typing.get_origin(part)
        if origin is typing.Literal:
            yield from typing.get_args(part)
        elif isinstance(part, type) and issubclass(part, enum.Enum):
            yield from (item.value for item in part)
        elif part is bool:
            yield not value
        elif part in (int, float):
            base = value if isinstance(value, (int, float)) and not isinstance(value, bool) else 1
            yield from (base + 1, base - 1, base * 2, base / 2, 0, 1, 0.5, 2, 45, 100)
        elif part is str:
            yield from ("another", "#102030")
        elif part is type(None):
            yield None
        elif origin in (list, tuple) and isinstance(value, (list, tuple)):
            yield from _lists(json.loads(json.dumps(value, default=str)), typing.get_args(part))


def _lists(items: list[Any], parts: tuple[Any, ...]) -> Iterator[list[Any]]:
    if not items:
        yield from ([candidate] for candidate in _candidates(parts[0], None)) if parts else ()
        return
    yield from (items[:-1], [*items, items[-1]], items[::-1])
    if all(isinstance(item, (int, float)) for item in items):
        yield [item + 1 for item in items]
