"""Migrations: old graph files keep running when plugins rename or change their nodes.

A plugin lists `Migration`s, each "before version v of this node type, such a thing was called so".  They apply in order
of version, to records saved with an older one.  A record without a version was written by hand: names that no longer
exist are migrated, and nothing else is assumed about it.

A parameter of the whole graph keeps the meaning that the file gave it.  Where it drives a parameter whose meaning
changed, the migration is handed the driven value with the node's others, and what it gives is the value of that node
alone: ``--set width=3`` and a graph around this one go on saying kilometres, and another node that the same parameter
drives gets its 3 as before.  Only a file that is upgraded takes the new meaning, for its default; it is refused where
one default would have to be two.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from nodegraph.errors import GraphError, Problem, sentence
from nodegraph.plugins import Migration, Registry

_ABSENT = object()


def migrate(data: dict[str, Any], registry: Registry, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document as it runs today, with every applicable migration applied.

    The given document is not modified; it is returned itself when nothing applies.

    Args:
        data: the document.
        registry: where migrations and node types are.
        given: values of exposed parameters over their defaults, by name.  Where one of them, or a default, went
            through the change of a node's parameters, it is in the node's record, and drives that node no more.
    """
    migration = _Pass(data, registry, given)
    if not migration.affected:
        return data
    migration.apply()
    migration.keep_driven_values()
    return migration.data


def upgrade(data: dict[str, Any], registry: Registry) -> tuple[dict[str, Any], list[str]]:
    """Return a document to be saved, with the node versions of today, and a line for each change made.

    Raises:
        GraphError: the default of an exposed parameter would have to be two values, or has no place any more.
    """
    migration, driven = _Pass(data, registry), _Pass(data, registry, {})
    migration.apply()
    driven.apply()
    migration.take_defaults(driven)
    migration.finish_records()
    return migration.data, migration.changes


class _Pass:
    """One document on its way to today.

    Attributes:
        data: the document, a copy from the first change on.
        affected: the nodes of which some migration speaks.
        changes: a line for each change made.
        changed: the nodes whose parameters were rewritten; their records hold what exposed parameters drive, unless
            `given` is None: then the values of exposed parameters are left out of it.
    """

    def __init__(self, data: dict[str, Any], registry: Registry, given: Mapping[str, Any] | None = None) -> None:
        self.by_type: dict[str, list[Migration]] = {}
        for migration in registry.migrations():
            self.by_type.setdefault(migration.type, []).append(migration)
        self.data = data
        self.affected = [id for id, record in data["nodes"].items() if record["type"] in self.by_type]
        self.changes: list[str] = []
        self.changed: set[str] = set()
        self._registry = registry
        self._given = given or {}
        self._drives = given is not None

    def apply(self) -> None:
        """Apply every migration to a copy of the document."""
        self.data = copy.deepcopy(self.data)
        for id in self.affected:
            self._record(id)

    # One node.

    def _record(self, id: str) -> None:
        record = self.data["nodes"][id]
        saved = record.get("version")
        done: set[int] = set()
        while True:
            waiting = [
                item
                for item in self.by_type.get(record["type"], ())
                if id_of(item) not in done and (self._is_gone(item) if saved is None else saved < item.version)
            ]
            if not waiting:
                return
            step = min(waiting, key=lambda item: item.version)
            done.add(id_of(step))
            self._step(id, record, step, by_hand=saved is None)
            if saved is not None:
                record["version"] = step.version
                # Versions of the new type count from where the old one was renamed.
                saved = step.version if step.new_type else saved

    def _is_gone(self, migration: Migration) -> bool:
        """Say whether what a migration renames is gone: only then does it concern a record of unknown age."""
        return not migration.new_type or self._registry.find(migration.type) is None

    def _step(self, id: str, record: dict[str, Any], step: Migration, *, by_hand: bool) -> None:
        node = self._registry.find(step.new_type or step.type)
        valid_params = set(node.parameters.fields) if node else set()
        valid_inputs = {port.name for port in node.inputs} if node else set()
        valid_outputs = {port.name for port in node.outputs} if node else set()
        if step.new_type:
            self.changes.append(f"node '{id}': type {record['type']} -> {step.new_type}")
            record["type"] = step.new_type
        for section, names, valid in (("params", step.parameters, valid_params), ("inputs", step.inputs, valid_inputs)):
            # A name that is still valid in a record of unknown age already means what it means today.
            renames = {old: new for old, new in names.items() if not (by_hand and old in valid)}
            entries = record.get(section, {})
            if hit := {
                old: new for old, new in renames.items() if old in entries and (new in renames or new not in entries)
            }:
                record[section] = {hit.get(name, name): value for name, value in entries.items()}
                self.changes += [f"node '{id}': {section[:-1]} '{old}' -> '{new}'" for old, new in hit.items()]
            if renames:
                _rename_exposed(self.data, id, renames, "parameters" if section == "params" else "inputs")
        outputs = {old: new for old, new in step.outputs.items() if not (by_hand and old in valid_outputs)}
        if outputs:
            _rename_outputs(self.data, id, outputs, self.changes)
        if step.change is not None and not by_hand:
            own = record.get("params", {})
            driven = self._driven(id) if self._drives and id not in self.changed else {}
            record["params"] = _changed(id, step, {**own, **driven})
            self.changed.add(id)
            self.changes.append(f"node '{id}': parameters rewritten for version {step.version}")

    # What exposed parameters drive.

    def value(self, name: str) -> Any:
        """Return the value of an exposed parameter, absent where it leaves the nodes their own."""
        return self._given.get(name, self.data["parameters"][name].get("default", _ABSENT))

    def drivers(self) -> dict[str, str]:
        """Return the exposed parameter that has the last word on each ``node.parameter`` that is driven."""
        exposed = self.data.get("parameters", {})
        return {
            drive: name
            for name, entry in exposed.items()
            if self.value(name) is not _ABSENT
            for drive in entry["drives"]
        }

    def _driven(self, id: str) -> dict[str, Any]:
        found = ((drive.partition("."), name) for drive, name in self.drivers().items())
        return {parameter: self.value(name) for (node, _, parameter), name in found if node == id and parameter}

    def is_kept(self, drive: str) -> bool:
        """Say whether what an exposed parameter drives went through a change, and so is in the node's record."""
        id, _, parameter = drive.partition(".")
        return id in self.changed and bool(parameter)

    def keep_driven_values(self) -> None:
        """Leave driven values of changed nodes in their records, and let nothing drive these any more."""
        for name, entry in self.data.get("parameters", {}).items():
            if self.value(name) is not _ABSENT:
                entry["drives"] = [drive for drive in entry["drives"] if not self.is_kept(drive)]

    def take_defaults(self, driven: _Pass) -> None:
        """Give exposed parameters the defaults that drive the same values as in `driven`, which kept these.

        Whatever else follows from a driven value is in the records of `driven`; a node's own value that a driven one
        hides stays hidden behind it.
        """
        values: dict[str, list[tuple[str, Any]]] = {}
        hidden: dict[str, set[str]] = {id: set() for id in driven.changed}
        for drive, name in driven.drivers().items():
            id, _, parameter = drive.partition(".")
            value = driven.value(name)
            if driven.is_kept(drive):
                hidden[id].add(parameter)
                value = driven.data["nodes"][id]["params"].get(parameter, _ABSENT)
            values.setdefault(name, []).append((drive, value))
        problems = []
        for name, entry in self.data.get("parameters", {}).items():
            if problem := _ambiguous(values.get(name, [])):
                problems.append(Problem(f"parameter '{name}'", problem))
            elif name in values and (value := values[name][0][1]) != entry["default"]:
                self.changes.append(f"parameter '{name}': default {entry['default']!r} -> {value!r}")
                entry["default"] = value
        if problems:
            raise GraphError(problems)
        for id, names in hidden.items():
            record, found = self.data["nodes"][id], driven.data["nodes"][id]["params"]
            own = {name: value for name, value in record["params"].items() if name in names or name in found}
            record["params"] = own | {name: value for name, value in found.items() if name not in names}

    def finish_records(self) -> None:
        """Give records of known node types the version of today, and leave out parameters that are none."""
        for id in self.changed:
            if not self.data["nodes"][id]["params"]:
                del self.data["nodes"][id]["params"]
        for id, record in self.data["nodes"].items():
            node = self._registry.find(record["type"])
            if node is not None and (record.get("version") or 0) < node.version:
                self.changes.append(f"node '{id}': version {record.get('version', 'none')} -> {node.version}")
                self.data["nodes"][id] = _with_version(record, node.version)


def id_of(migration: Migration) -> int:
    """Return the identity of a migration: two equal ones of two plugins are still two."""
    return id(migration)


def _changed(id: str, step: Migration, params: dict[str, Any]) -> dict[str, Any]:
    assert step.change is not None
    try:
        found: Any = step.change(copy.deepcopy(params))
    except Exception as error:  # whatever a stranger's function may raise
        raise GraphError(
            f"the migration of {step.type} to version {step.version} failed ({sentence(error)})", f"node '{id}'"
        ) from error
    if not isinstance(found, dict):
        message = (
            f"the migration of {step.type} to version {step.version} gave {type(found).__name__}, not the parameters"
        )
        raise GraphError(message, f"node '{id}'")
    return found


def _ambiguous(values: list[tuple[str, Any]]) -> str:
    """Say why no single default gives each ``node.parameter`` its value, or return an empty text."""
    for drive, value in values:
        if value is _ABSENT:
            return f"drives '{drive}', which a migration replaced; drive what took its place"
        first, expected = values[0]
        if value != expected:
            return (
                f"its default is {expected!r} for '{first}' and {value!r} for '{drive}', as one changed its meaning; "
                "expose two parameters, then upgrade"
            )
    return ""


def _rename_exposed(data: dict[str, Any], id: str, names: dict[str, str], section: str) -> None:
    key = "drives" if section == "parameters" else "feeds"
    for entry in data.get(section, {}).values():
        entry[key] = [_renamed(item, id, names) for item in entry[key]]


def _rename_outputs(data: dict[str, Any], id: str, names: dict[str, str], changes: list[str]) -> None:
    for record in data["nodes"].values():
        inputs = record.get("inputs", {})
        for port, links in inputs.items():
            inputs[port] = (
                _renamed(links, id, names) if isinstance(links, str) else [_renamed(link, id, names) for link in links]
            )
    for name, source in data.get("outputs", {}).items():
        data["outputs"][name] = _renamed(source, id, names)
    changes += [f"node '{id}': output '{old}' -> '{new}'" for old, new in names.items()]


def _renamed(reference: str, id: str, names: dict[str, str]) -> str:
    node, _, port = reference.partition(".")
    return f"{node}.{names[port]}" if node == id and port in names else reference


def _with_version(record: dict[str, Any], version: int) -> dict[str, Any]:
    rest = {key: value for key, value in record.items() if key not in ("type", "version")}
    return {"type": record["type"], "version": version, **rest}
