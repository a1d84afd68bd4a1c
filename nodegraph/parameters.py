"""Parameters of a node: JSON values with a type, a range, a unit and one line of meaning, checked by pydantic."""

from __future__ import annotations

import json
import re
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import pydantic
from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic_core import to_json

from nodegraph.errors import PluginError, nearest

REQUIRED: Any = object()
"""Stands for the default of a parameter that has none."""


_NUMBERED = "parameter_number_"


@dataclass(frozen=True, slots=True)
class Param:
    """What a parameter means and may be; stands in the annotation: ``Annotated[float, Param("...", ge=0, unit="m")]``.

    Attributes:
        description: one line for a person.
        ge, gt, le, lt: bounds of a number (inclusive, exclusive).
        unit: physical unit of the value as text, such as ``"m"`` or ``"deg"``.
        min_length, max_length: bounds of the length of a list or string.
    """

    description: str = ""
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    unit: str = ""
    min_length: int | None = None
    max_length: int | None = None

    def constraints(self) -> Iterator[object]:
        """Yield the bounds as annotations that pydantic understands."""
        for kind, bound in ((Ge, self.ge), (Gt, self.gt), (Le, self.le), (Lt, self.lt)):
            if bound is not None:
                yield kind(bound)
        if self.min_length is not None:
            yield MinLen(self.min_length)
        if self.max_length is not None:
            yield MaxLen(self.max_length)


@dataclass(frozen=True, slots=True)
class InputFile:
    """Marks a path parameter as a file that the node reads: its contents, not its path, decide what is cached.

    Attributes:
        sidecars: suffixes of files of the same stem that the reader also looks at, such as ``(".prj", ".hdr")``;
            a suffix that starts with ``*`` is appended to the whole name (``"*.aux.xml"``).
        type: the port type that the node reads from it, where it asks the registry for the format: the code of that
            format and the sidecars it looks at then count for the cache, and a suffix of no format is refused at once.
    """

    sidecars: tuple[str, ...] = ()
    type: type | None = None

    def related(self, path: Path) -> list[Path]:
        """Return `path` and the sidecars of it that exist, in a fixed order."""
        return [path, *(sidecar for sidecar in self.candidates(path)[1:] if sidecar.is_file())]

    def candidates(self, path: Path) -> list[Path]:
        """Return `path` and every sidecar of it that the reader would look at, whether it exists or not."""
        found = [path]
        for suffix in self.sidecars:
            sidecar = path.with_name(path.name + suffix[1:]) if suffix.startswith("*") else path.with_suffix(suffix)
            if sidecar != path:
                found.append(sidecar)
        return found


@dataclass(frozen=True, slots=True)
class OutputFile:
    """Marks a text parameter as the name of a file that the node makes, relative to the run's output folder.

    Attributes:
        type: the port type that the node writes to it, where it asks the registry for the format; as of `InputFile`.
    """

    type: type | None = None


InputPath = Annotated[Path, InputFile()]
"""A file to read; relative paths start at the folder of the graph file."""

OutputName = Annotated[str, OutputFile()]
"""The name of a file to write, relative to the output folder; may hold folders, never ``..``."""


@dataclass(frozen=True, slots=True)
class Checked:
    """Parameters after validation: `values` by name for the call, `canonical` as JSON bytes for the cache key."""

    values: dict[str, Any]
    canonical: bytes


@dataclass(frozen=True, slots=True)
class Field:
    """One parameter as declared."""

    name: str
    annotation: Any
    default: Any = REQUIRED
    param: Param = field(default_factory=Param)
    input_file: InputFile | None = None
    output_file: OutputFile | None = None

    @property
    def required(self) -> bool:
        """True where the parameter has no default."""
        return self.default is REQUIRED


class ParameterSet:
    """All parameters of one node.  The pydantic model is built on first use."""

    def __init__(self, title: str, declared: Mapping[str, tuple[Any, Any]]) -> None:
        self._title = title
        self.fields: dict[str, Field] = {
            name: _field(name, annotation, default) for name, (annotation, default) in declared.items()
        }

    @cached_property
    def input_files(self) -> tuple[Field, ...]:
        """The parameters that name files to read."""
        return tuple(item for item in self.fields.values() if item.input_file is not None)

    @cached_property
    def output_files(self) -> tuple[Field, ...]:
        """The parameters that name files to write."""
        return tuple(item for item in self.fields.values() if item.output_file is not None)

    @cached_property
    def model(self) -> type[pydantic.BaseModel]:
        """The pydantic model that checks the parameters: strict, finite numbers, no unknown names.

        Its fields are numbered and have the parameters' names as aliases, so that any name will do.

        Raises:
            PluginError: an annotation says nothing that JSON can hold.
        """
        try:
            return self._model(self.fields)
        except Exception as error:  # pydantic has many
            for name, item in self.fields.items():
                try:
                    self._model({name: item})
                except Exception as cause:
                    raise self._undeclarable(f"parameter '{name}'", cause) from cause
            raise self._undeclarable("the parameters", error) from error

    def _undeclarable(self, what: str, error: Exception) -> PluginError:
        why = " ".join(str(error).split("\n", 1)[0].split())
        return PluginError(f"node '{self._title}': {what} cannot be checked ({why})")

    def _model(self, fields: Mapping[str, Field]) -> type[pydantic.BaseModel]:
        definitions: dict[str, Any] = {}
        for position, item in enumerate(fields.values()):
            extra: dict[str, Any] = {"unit": item.param.unit} if item.param.unit else {}
            annotation = item.annotation
            for constraint in item.param.constraints():
                annotation = Annotated[annotation, constraint]
            default = ... if item.required else _spelt_out(item.default)
            info = pydantic.Field(
                default, alias=item.name, description=item.param.description or None, json_schema_extra=extra or None
            )
            definitions[f"{_NUMBERED}{position}"] = (annotation, info)
        config = pydantic.ConfigDict(
            extra="forbid",
            strict=True,
            allow_inf_nan=False,
            validate_default=True,
            arbitrary_types_allowed=False,
            protected_namespaces=(),
            ser_json_inf_nan="constants",
            regex_engine="python-re",
        )
        return pydantic.create_model(re.sub(r"\W", "_", self._title), __config__=config, **definitions)

    def check(self, raw: Mapping[str, Any]) -> Checked:
        """Return the parameters with defaults filled in.

        Raises:
            ParameterErrors: with every problem found, by parameter.
        """
        if not raw and self._defaults is not None:
            return self._defaults
        return self._check(raw)

    @cached_property
    def _defaults(self) -> Checked | None:
        try:
            return self._check({})
        except ParameterErrors:
            return None

    def _check(self, raw: Mapping[str, Any]) -> Checked:
        try:
            text = to_json(dict(raw), inf_nan_mode="constants")
        except (ValueError, TypeError, RecursionError) as error:
            raise ParameterErrors([("", f"the parameters are not JSON values ({error})")]) from error
        if not self.fields and not raw:
            return Checked({}, b"{}")
        try:
            model = self.model.__pydantic_validator__.validate_json(text)
        except pydantic.ValidationError as error:
            raise ParameterErrors([self._explain(item) for item in error.errors(include_url=False)]) from error
        except TypeError as error:  # a bound that does not fit the type
            raise self._undeclarable("a parameter", error) from error
        # A field holds exactly what the annotation says: tuples, literals, paths, enumerations, nested models.
        values = {name: getattr(model, f"{_NUMBERED}{position}") for position, name in enumerate(self.fields)}
        dumped = model.model_dump(mode="json", by_alias=True)
        for item in self.input_files:
            # Which file it is decides the result, where it lies does not: its contents enter the key by themselves.
            dumped[item.name] = _names_only(dumped[item.name])
        return Checked(values, json.dumps(dumped, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode())

    def _explain(self, error: Any) -> tuple[str, str]:
        path = error["loc"]
        name = str(path[0]) if path else ""
        if name.startswith(_NUMBERED) and name not in self.fields:  # a wrong default
            name = list(self.fields)[int(name.removeprefix(_NUMBERED))]
        inside = "".join(f"[{part}]" for part in path[1:] if isinstance(part, int))
        if error["type"] == "extra_forbidden" and len(path) == 1:
            return name, f"unknown parameter '{name}'; {nearest(name, self.fields)}"
        if error["type"] == "missing" and len(path) == 1:
            unit = self.fields[name].param.unit if name in self.fields else ""
            return name, f"parameter '{name}' is missing" + (f" (in {unit})" if unit else "")
        message = error["msg"][:1].lower() + error["msg"][1:]
        given = json.dumps(error["input"], default=str)
        given = given if len(given) <= 60 else given[:57] + "..."
        return name, f"parameter '{name}{inside}': {message.replace('input should', 'should', 1)}, got {given}"

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON Schema of the parameters as an object."""
        return self.model.model_json_schema()

    def non_defaults(self, raw: Mapping[str, Any]) -> dict[str, Any]:
        """Return `raw` without the values that equal their defaults; unknown or wrong ones stay."""
        try:
            checked = self.check(raw).canonical
        except ParameterErrors:
            return dict(raw)
        kept = {}
        for name, value in raw.items():
            without = {key: item for key, item in raw.items() if key != name}
            if self.fields[name].required or self.check(without).canonical != checked:
                kept[name] = value
        return kept


class ParameterErrors(ValueError):
    """What is wrong with the parameters of one node: (parameter name or empty, sentence) pairs."""

    def __init__(self, items: list[tuple[str, str]]) -> None:
        self.items = items
        super().__init__("; ".join(message for _, message in items))


def _spelt_out(default: Any) -> Any:
    """Return a default with its paths as text: defaults are checked as JSON is, which knows no paths."""
    if type(default) in (list, tuple):
        return type(default)(map(_spelt_out, default))
    return str(default) if isinstance(default, Path) else default


def _names_only(value: Any) -> Any:
    if isinstance(value, list):
        return [_names_only(item) for item in value]
    return Path(value).name if isinstance(value, str) else value


def _field(name: str, annotation: Any, default: Any) -> Field:
    found: dict[type, Any] = {}
    kept = _strip(annotation, found)
    return Field(name, kept, default, found.get(Param, Param()), found.get(InputFile), found.get(OutputFile))


def _strip(annotation: Any, found: dict[type, Any]) -> Any:
    """Collect this module's marks from an annotation, at any depth; pydantic never sees a `Param`."""
    if typing.get_origin(annotation) is Annotated:
        base, *marks = typing.get_args(annotation)
        others = []
        for mark in marks:
            if isinstance(mark, (Param, InputFile, OutputFile)):
                found.setdefault(type(mark), mark)
            else:
                others.append(mark)
        base = _strip(base, found)
        for mark in others:
            base = Annotated[base, mark]
        return base
    for argument in typing.get_args(annotation):
        if not isinstance(argument, (str, int, float, bool, bytes, type(None))):
            _strip(argument, found)
    return annotation
