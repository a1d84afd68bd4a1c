"""Migrations: old graph files keep running when plugins rename or change their nodes.

A plugin lists `Migration`s, each "before version v of this node type, such a thing was called so".  They apply in order
of version, to records saved with an older one.  A record without a version was written by hand: names that no longer
exist are migrated, and nothing else is assumed about it.
"""

from __future__ import annotations

import copy
from typing import Any

from nodegraph.errors import GraphError, sentence
from nodegraph.plugins import Migration, Registry


def migrate(
    data: dict[str, Any], registry: Registry, *, write_versions: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Return a document with every applicable migration applied, and a line for each change made.

    The given document is not modified; it is returned itself when nothing applies.  With `write_versions`, records of
    known node types get the version of today.
    """
    by_type: dict[str, list[Migration]] = {}
    for migration in registry.migrations():
        by_type.setdefault(migration.type, []).append(migration)
    affected = [id for id, record in data["nodes"].items() if record["type"] in by_type]
    if not affected and not write_versions:
        return data, []
    data = copy.deepcopy(data)
    changes: list[str] = []
    for id in affected:
        _migrate_record(data, id, by_type, registry, changes)
    if write_versions:
        for id, record in data["nodes"].items():
            node = registry.find(record["type"])
            if node is not None and (record.get("version") or 0) < node.version:
                changes.append(f"node '{id}': version {record.get('version', 'none')} -> {node.version}")
                data["nodes"][id] = _with_version(record, node.version)
    return data, changes


def _migrate_record(
    data: dict[str, Any], id: str, by_type: dict[str, list[Migration]], registry: Registry, changes: list[str]
) -> None:
    record = data["nodes"][id]
    saved = record.get("version")
    done: set[int] = set()
    while True:
        waiting = [
            item
            for item in by_type.get(record["type"], ())
            if id_of(item) not in done and (_is_gone(item, registry) if saved is None else saved < item.version)
        ]
        if not waiting:
            return
        step = min(waiting, key=lambda item: item.version)
        done.add(id_of(step))
        _apply(data, id, record, step, registry, changes, by_hand=saved is None)
        if saved is not None:
            record["version"] = step.version
            # Versions of the new type count from where the old one was renamed.
            saved = step.version if step.new_type else saved


def _is_gone(migration: Migration, registry: Registry) -> bool:
    """Say whether what a migration renames is no longer there: only then does it concern a record of unknown age."""
    return not migration.new_type or registry.find(migration.type) is None


def id_of(migration: Migration) -> int:
    """Return the identity of a migration: two equal ones of two plugins are still two."""
    return id(migration)


def _apply(
    data: dict[str, Any],
    id: str,
    record: dict[str, Any],
    step: Migration,
    registry: Registry,
    changes: list[str],
    *,
    by_hand: bool,
) -> None:
    node = registry.find(step.new_type or step.type)
    valid_params = set(node.parameters.fields) if node else set()
    valid_inputs = {port.name for port in node.inputs} if node else set()
    valid_outputs = {port.name for port in node.outputs} if node else set()
    if step.new_type:
        changes.append(f"node '{id}': type {record['type']} -> {step.new_type}")
        record["type"] = step.new_type
    for section, names, valid in (("params", step.parameters, valid_params), ("inputs", step.inputs, valid_inputs)):
        # A name that is still valid in a record of unknown age already means what it means today.
        renames = {old: new for old, new in names.items() if not (by_hand and old in valid)}
        entries = record.get(section, {})
        if hit := {
            old: new for old, new in renames.items() if old in entries and (new in renames or new not in entries)
        }:
            record[section] = {hit.get(name, name): value for name, value in entries.items()}
            changes += [f"node '{id}': {section[:-1]} '{old}' -> '{new}'" for old, new in hit.items()]
        if renames:
            _rename_exposed(data, id, renames, "parameters" if section == "params" else "inputs")
    outputs = {old: new for old, new in step.outputs.items() if not (by_hand and old in valid_outputs)}
    if outputs:
        _rename_outputs(data, id, outputs, changes)
    if step.change is not None and not by_hand:
        record["params"] = _changed(id, step, record.get("params", {}))
        changes.append(f"node '{id}': parameters rewritten for version {step.version}")


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
