"""Layers as JSON that a person can edit.

    {
      "format": "nodegraph-layers/1",
      "layers": {
        "name": "rock", "colour": "#6b625a", "roughness": 4.0, "relief": {"kind": "billow", "wavelength": 60.0},
        "children": [
          {"name": "snow", "colour": "#ffffff", "constraints": [
            {"quantity": "altitude", "hat": [2400, 2700, null, null]},
            {"quantity": "temperature", "low": -10, "high": 12, "samples": [1, 0.8, 0]}
          ]}
        ]
      }
    }

What is left out has the default of `SurfaceLayers`.  A colour is ``#rrggbb``, or three numbers from 0 to 1 where it is
no such code.  A side of a hat that is open has null at both ends.  Numbers are written so that reading gives the same
bits.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from math import inf, isfinite
from typing import Any, get_args

import numpy as np

from nodegraph.errors import GraphError, nearest
from nodegraph.jsontext import parse
from nodegraph_terrain.noise import Kind
from nodegraph_texture.constraints import Constraint, Hat, Sampled
from nodegraph_texture.layer import check_quantity, colour_of
from nodegraph_texture.layers import Colour, Roughness, SurfaceLayers

FORMAT = "nodegraph-layers/1"

NUMBERS = ("scale", "bias", "roughness", "variation")
NOISES = ("noise", "relief", "tint")
KEYS = ("name", "colour", "constraints", *NUMBERS, *NOISES, "children")

DEEPEST = 24
"""Levels of a hierarchy that a file can hold; JSON is read to a limited depth."""


def written(layers: SurfaceLayers) -> str:
    """Return layers as the text of a file.

    Raises:
        ValueError: the hierarchy is deeper than a file can hold, or a constraint is of an unknown type.
    """
    if max(level for _, _, level in layers.walk()) >= DEEPEST:
        raise ValueError(f"the hierarchy has more than {DEEPEST} levels, more than a file can hold")
    return _pretty({"format": FORMAT, "layers": _layer_data(layers)}) + "\n"


def read(text: str | bytes, where: str) -> SurfaceLayers:
    """Return the layers that a text describes.

    Raises:
        ValueError: it is no such file; every problem with its place, one sentence each.
    """
    if not text.strip():
        raise ValueError(f'\'{where}\' is empty; a file of layers starts with {{"format": "{FORMAT}", "layers": ...')
    try:
        data = parse(text, where)
    except GraphError as error:
        raise ValueError(str(error)) from None
    reader = _Reader()
    layers = None
    body = reader.table(data, "the file", ("format", "layers"), ("format", "layers"))
    if body is not None:
        if body.get("format", FORMAT) != FORMAT:
            reader.problem("format", f"{body['format']!r} is not '{FORMAT}', the one this version reads")
        elif "layers" in body:
            layers = reader.layer(body["layers"], "layers")
    if reader.problems or layers is None:
        listed = "\n".join(reader.problems)
        raise ValueError(f"'{where}' holds no layers that can be read:\n{listed}")
    return layers


# Writing.


def _layer_data(layer: SurfaceLayers) -> dict[str, Any]:
    data: dict[str, Any] = {"name": layer.name, "colour": _colour_data(layer.colour)}
    if layer.constraints:
        data["constraints"] = [_constraint_data(item) for item in layer.constraints]
    plain = SurfaceLayers("plain", layer.colour)
    data |= {key: getattr(layer, key) for key in NUMBERS if getattr(layer, key) != getattr(plain, key)}
    for key in NOISES:
        own, usual = getattr(layer, key), getattr(plain, key)
        parts = {item.name: getattr(own, item.name) for item in fields(own)}
        different = {name: value for name, value in parts.items() if value != getattr(usual, name)}
        if different:
            data[key] = different
    if layer.children:
        data["children"] = [_layer_data(child) for child in layer.children]
    return data


def _colour_data(colour: Colour) -> str | list[float]:
    code = "#" + "".join(f"{round(255 * part):02x}" for part in colour)
    return code if colour_of(code) == tuple(colour) else list(colour)


def _constraint_data(constraint: Constraint) -> dict[str, Any]:
    if isinstance(constraint, Hat):
        ends = [*constraint.rise, *constraint.fall]
        usual = (-inf, -inf, inf, inf)
        # An end at the other infinity makes a hat that is 0 everywhere: rare, and written out.
        return {
            "quantity": constraint.quantity,
            "hat": [
                end if isfinite(end) else None if end == open_ else str(end)
                for end, open_ in zip(ends, usual, strict=True)
            ],
        }
    if isinstance(constraint, Sampled):
        # The shortest digits that give the same float32.
        samples = [float(str(item)) for item in constraint.samples]
        return {"quantity": constraint.quantity, "low": constraint.low, "high": constraint.high, "samples": samples}
    raise ValueError(f"a constraint of type {type(constraint).__name__} cannot be written; use a hat or samples")


def _pretty(data: Any, indent: int = 0, room: int = 110) -> str:
    """Return JSON with whatever fits on a line on one line."""
    flat = json.dumps(data, ensure_ascii=False, allow_nan=False)
    if len(flat) + indent <= room or not isinstance(data, (dict, list)):
        return flat
    if isinstance(data, list) and all(not isinstance(item, (dict, list)) for item in data):
        return _filled(data, indent, room)
    inner = " " * (indent + 2)
    if isinstance(data, dict):
        lines = [
            f"{inner}{json.dumps(key, ensure_ascii=False)}: {_pretty(item, indent + 2, room)}"
            for key, item in data.items()
        ]
        return "{\n" + ",\n".join(lines) + "\n" + " " * indent + "}"
    return "[\n" + ",\n".join(inner + _pretty(item, indent + 2, room) for item in data) + "\n" + " " * indent + "]"


def _filled(items: list[Any], indent: int, room: int) -> str:
    """Return a list of numbers as lines that are as long as may be."""
    lines, line = [], " " * (indent + 2)
    for number, item in enumerate(items):
        text = json.dumps(item, allow_nan=False) + ("," if number < len(items) - 1 else "")
        if len(line) + len(text) > room and line.strip():
            lines.append(line.rstrip())
            line = " " * (indent + 2)
        line += text + " "
    return "[\n" + "\n".join([*lines, line.rstrip()]) + "\n" + " " * indent + "]"


# Reading.


class _Reader:
    """Collects every problem; what is wrong reads as None."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    def problem(self, place: str, message: str) -> None:
        self.problems.append(f"{place}: {message}")

    def table(
        self, data: Any, place: str, keys: tuple[str, ...], required: tuple[str, ...] = ()
    ) -> Mapping[str, Any] | None:
        """Return an object whose keys are all known and none of the required ones missing."""
        if not isinstance(data, dict):
            self.problem(place, f"must be an object {{...}}, not {_said(data)}")
            return None
        for key in data:
            if key not in keys:
                self.problem(place, f"there is no key '{key}'; {nearest(key, keys)}")
        for key in required:
            if key not in data:
                self.problem(place, f"the key '{key}' is missing")
        return data

    def made(self, place: str, make: Callable[[], Any]) -> Any:
        """Return what a function makes, or None where it refuses."""
        try:
            return make()
        except ValueError as error:
            self.problem(place, str(error))
            return None

    def number(self, data: Any, place: str) -> float | None:
        if isinstance(data, bool) or not isinstance(data, (int, float)):
            self.problem(place, f"must be a number, not {_said(data)}")
            return None
        return float(data)

    def listed(self, data: Any, place: str) -> list[Any]:
        if isinstance(data, list):
            return data
        self.problem(place, f"must be a list [...], not {_said(data)}")
        return []

    def layer(self, data: Any, place: str) -> SurfaceLayers | None:
        body = self.table(data, place, KEYS, ("name", "colour"))
        if body is None:
            return None
        before = len(self.problems)
        parts: dict[str, Any] = {}
        if "name" in body:
            parts["name"] = body["name"]
            if not isinstance(body["name"], str):
                self.problem(f"{place}.name", f"must be a text, not {_said(body['name'])}")
        if "colour" in body:
            parts["colour"] = self.colour(body["colour"], f"{place}.colour")
        for key in NUMBERS:
            if key in body:
                parts[key] = self.number(body[key], f"{place}.{key}")
        for key in NOISES:
            if key in body:
                parts[key] = self.roughness(body[key], f"{place}.{key}")
        for key, one in (("constraints", self.constraint), ("children", self.layer)):
            if key in body:
                items = self.listed(body[key], f"{place}.{key}")
                parts[key] = tuple([one(item, f"{place}.{key}[{i}]") for i, item in enumerate(items)])
        if len(self.problems) > before or not {"name", "colour"} <= parts.keys():
            return None
        layer: SurfaceLayers | None = self.made(place, lambda: SurfaceLayers(**parts))
        return layer

    def colour(self, data: Any, place: str) -> Colour | None:
        if isinstance(data, str):
            code: Colour | None = self.made(place, lambda: colour_of(data))
            return code
        numbers = [self.number(item, f"{place}[{i}]") for i, item in enumerate(self.listed(data, place))]
        if any(item is None for item in numbers) or not isinstance(data, list):
            return None
        if len(numbers) != 3 or not all(item is not None and 0 <= item <= 1 for item in numbers):
            self.problem(place, 'must be "#rrggbb" or three numbers from 0 to 1')
            return None
        return numbers[0] or 0.0, numbers[1] or 0.0, numbers[2] or 0.0

    def roughness(self, data: Any, place: str) -> Roughness | None:
        names = tuple(item.name for item in fields(Roughness))
        body = self.table(data, place, names)
        if body is None:
            return None
        before = len(self.problems)
        parts: dict[str, Any] = {}
        for key in (name for name in names if name in body):
            value = body[key]
            if key == "kind":
                if value not in get_args(Kind):
                    self.problem(f"{place}.kind", f"{value!r} is none of {', '.join(get_args(Kind))}")
                parts[key] = value
            elif key in ("octaves", "seed"):
                if isinstance(value, bool) or not isinstance(value, int):
                    self.problem(f"{place}.{key}", f"must be a whole number, not {_said(value)}")
                parts[key] = value
            else:
                parts[key] = self.number(value, f"{place}.{key}")
        if len(self.problems) > before:
            return None
        roughness: Roughness | None = self.made(place, lambda: Roughness(**parts))
        return roughness

    def constraint(self, data: Any, place: str) -> Constraint | None:
        hat = isinstance(data, dict) and "hat" in data
        wanted = ("quantity", "hat") if hat else ("quantity", "low", "high", "samples")
        body = self.table(data, place, wanted, wanted)
        if body is None or not set(wanted) <= body.keys():
            return None
        before = len(self.problems)
        name = body["quantity"]
        if isinstance(name, str):
            self.made(f"{place}.quantity", lambda: check_quantity(name))
        else:
            self.problem(f"{place}.quantity", f"must be a text, not {_said(name)}")
        if hat:
            ends = self.ends(body["hat"], f"{place}.hat")
            make: Callable[[], Constraint] = lambda: Hat(name, (ends[0], ends[1]), (ends[2], ends[3]))  # noqa: E731
        else:
            low, high = (self.number(body[key], f"{place}.{key}") for key in ("low", "high"))
            samples = [
                self.number(item, f"{place}.samples[{i}]")
                for i, item in enumerate(self.listed(body["samples"], f"{place}.samples"))
            ]
            make = lambda: Sampled(name, low or 0.0, high or 0.0, np.array(samples, np.float32))  # noqa: E731
        if len(self.problems) > before:
            return None
        made: Constraint | None = self.made(place, make)
        return made

    def ends(self, data: Any, place: str) -> list[float]:
        items = self.listed(data, place)
        if isinstance(data, list) and len(items) != 4:
            self.problem(place, f"must have four numbers, not {len(items)}; null leaves a side open")
        found = []
        for i, (item, open_) in enumerate(zip(items, (-inf, -inf, inf, inf), strict=False)):
            if item is None:
                found.append(open_)
            elif item in ("inf", "-inf"):
                found.append(float(item))
            else:
                number = self.number(item, f"{place}[{i}]")
                found.append(0.0 if number is None else number)
        return found


def _said(data: Any) -> str:
    """Return a value as a problem quotes it."""
    text = json.dumps(data, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "..."
