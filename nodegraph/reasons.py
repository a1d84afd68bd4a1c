"""Why a node is computed: the difference between what went into its key last time and now, in words."""

from __future__ import annotations

import json
from collections.abc import Iterator

from nodegraph.cache import Recipe

NEVER = "never computed"
FORCED = "forced"
EVICTED = "evicted"
CHECKED = "checked against the cache"
NOT_STORED = "not stored, as it computes faster than it loads"


def explain(old: Recipe, new: Recipe) -> str:
    """Return what changed from one recipe to the next, most telling first, joined with semicolons.

    >>> a = Recipe("t.f", 1, "c", '{"sigma":40}', ("x",), b"1" * 16, {}, "")
    >>> explain(a, a._replace(params='{"sigma":60}', inputs=b"2" * 16))
    'parameter sigma changed 40 -> 60; input x changed'
    """
    return "; ".join(_differences(old, new)) or EVICTED


def _differences(old: Recipe, new: Recipe) -> Iterator[str]:
    if old.type != new.type:
        yield f"type changed {old.type} -> {new.type}"
        return
    if old.version != new.version:
        yield f"version changed {old.version} -> {new.version}"
    if old.code != new.code:
        yield "code changed"
    before, after = json.loads(old.params or "{}"), json.loads(new.params or "{}")
    for name in [*before, *(name for name in after if name not in before)]:
        if name not in after:
            yield f"parameter {name} is gone"
        elif name not in before:
            yield f"parameter {name} is new"
        elif json.dumps(before[name]) != json.dumps(after[name]) and name not in new.files:
            yield f"parameter {name} changed {_short(before[name])} -> {_short(after[name])}"
    for name, entry in new.files.items():
        if name in old.files and old.files[name] != entry:
            yield f"file {entry.partition(' ')[2] or name} changed"
    yield from _input_differences(old, new)
    if old.device != new.device:
        yield f"device changed {old.device or 'none'} -> {new.device or 'none'}"


def _input_differences(old: Recipe, new: Recipe) -> Iterator[str]:
    for port in dict.fromkeys(new.ports + old.ports):
        before, after = old.links(port), new.links(port)
        if not before:
            yield f"input {port} is linked now"
        elif not after:
            yield f"input {port} is not linked any more"
        elif len(before) != len(after):
            yield f"input {port} has {len(after)} links, had {len(before)}"
        elif before != after:
            yield f"input {port} changed"


def _short(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "..."
