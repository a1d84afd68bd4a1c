"""Statistics of sparse terrains as tables in files."""

from __future__ import annotations

import csv
import json
from io import StringIO
from pathlib import PurePosixPath
from typing import Annotated

from nodegraph import File, OutputName, Param, node
from nodegraph_sparse.report import Report


@node(version=1)
def save_statistics(
    *statistics: Report, name: Annotated[OutputName, Param("File to write; the suffix is the format: csv or json.")]
) -> File:
    """Write statistics as a table: a row for each terrain, or for each iteration of a learning.

    - ``.csv``: a header and a line for each row; empty where a number does not exist.
    - ``.json``: a list of objects; null where a number does not exist.

    Args:
        statistics: of sparse.sparse_statistics, sparse.rate_distortion or sparse.ksvd; rows follow one another.
        name: the file.

    Raises:
        ValueError: the suffix is another, or there is no input.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in (".csv", ".json"):
        raise ValueError(f"'{name}' ends in '{suffix}'; choose .csv or .json")
    if not statistics:
        raise ValueError("there are no statistics to write; link one input or more")
    rows = [row for one in statistics for row in one.records()]
    if suffix == ".json":
        return File.of(name, (json.dumps(rows, indent=1, allow_nan=False) + "\n").encode())
    text = StringIO()
    columns = list(dict.fromkeys(column for row in rows for column in row))
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return File.of(name, text.getvalue().encode())
