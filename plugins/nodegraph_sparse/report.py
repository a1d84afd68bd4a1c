"""Numbers on the wire that can be written as a table."""

from __future__ import annotations

import json
from typing import Any

from nodegraph import port_type


@port_type
class Report:
    """Numbers that can be written as a table; subclasses say which."""

    def records(self) -> list[dict[str, Any]]:
        """Return a record for each row: numbers by name; none where one does not exist."""
        raise NotImplementedError

    def to_json(self) -> str:
        """Return the rows as JSON."""
        return json.dumps(self.records(), allow_nan=False)
