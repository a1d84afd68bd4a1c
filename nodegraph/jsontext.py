"""JSON as people write and read it: strict parsing with errors that say where, and one house style for writing.

Strict means: no duplicate names, no NaN or infinities (``1e400`` included), no half of a surrogate pair, and no nesting
deeper than any graph needs.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any, NoReturn

from nodegraph.errors import GraphError

_WIDTH = 110
_TOO_DEEP = "nested too deeply to read; a graph needs a few levels only"
_MAX_DEPTH = 100
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def parse(text: str | bytes, where: str) -> Any:
    """Return the data in a JSON text.  Raises `GraphError`, with line and column, where the text is not strict JSON."""

    def refuse(constant: str) -> NoReturn:
        raise GraphError(f"{constant} is not a JSON number; give a finite number", where)

    def number(literal: str) -> float:
        value = float(literal)
        if not math.isfinite(value):
            refuse(literal if len(literal) <= 20 else literal[:17] + "...")
        return value

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        data = dict(pairs)
        if len(data) != len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise GraphError(f"the name '{twice}' stands twice in one object; names must be unique", where)
        return data

    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8-sig")
        data = json.loads(
            text.removeprefix("\ufeff"), parse_constant=refuse, parse_float=number, object_pairs_hook=unique
        )
    except UnicodeDecodeError as error:
        raise GraphError(f"not UTF-8 text (byte {error.start}); a graph is a JSON file in UTF-8", where) from error
    except json.JSONDecodeError as error:
        if not text.strip():
            raise GraphError('the file is empty; a graph starts with {"format": "nodegraph/1", ...}', where) from None
        raise GraphError(f"not JSON: {error.msg.lower()} at line {error.lineno}, column {error.colno}", where) from None
    except RecursionError:
        raise GraphError(_TOO_DEEP, where) from None
    except ValueError as error:  # an integer of thousands of digits
        raise GraphError(f"a number is too long to read ({error})", where) from None
    if _is_deep(data):
        raise GraphError(_TOO_DEEP, where)
    if _SURROGATE.search(text) and not _is_text(data):
        raise GraphError("a text holds half of a surrogate pair (\\ud800 to \\udfff); write the whole character", where)
    return data


def _is_deep(data: Any) -> bool:
    level = [data] if isinstance(data, (dict, list)) else []
    for _ in range(_MAX_DEPTH):
        if not level:
            return False
        inner = [item.values() if isinstance(item, dict) else item for item in level]
        level = [item for items in inner for item in items if isinstance(item, (dict, list))]
    return True


def _is_text(data: Any) -> bool:
    try:
        json.dumps(data, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        return False
    return True


def write(data: Any) -> str:
    """Return `data` as JSON text in the house style, with a final newline.

    Objects open over several lines down to one node a line; whatever fits a line below that stays on it.  A change of
    one node therefore changes one line or few.
    """
    return _write(data, 0, "", forced=2) + "\n"


def _write(data: Any, indent: int, key: str, *, forced: int) -> str:
    flat = json.dumps(data, ensure_ascii=False, allow_nan=False)
    nested = isinstance(data, (dict, list)) and bool(data)
    must_open = nested and isinstance(data, dict) and forced > 0 and (forced == 2 or key == "nodes")
    if not nested or (not must_open and indent + len(key) + 4 + len(flat) <= _WIDTH):
        return flat
    pad = " " * (indent + 2)
    if isinstance(data, dict):
        items = [
            f"{json.dumps(name, ensure_ascii=False)}: {_write(item, indent + 2, name, forced=forced - 1)}"
            for name, item in data.items()
        ]
        opening, closing = "{", "}"
    else:
        items = [_write(item, indent + 2, "", forced=0) for item in data]
        opening, closing = "[", "]"
    return f"{opening}\n{pad}" + f",\n{pad}".join(items) + f"\n{' ' * indent}{closing}"
