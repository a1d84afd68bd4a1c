"""Reading sparse terrains from files."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from nodegraph import InputPath, Param, node
from nodegraph_sparse.container import unpacked
from nodegraph_sparse.dictionary import Dictionary, SparseCode


class Loaded(NamedTuple):
    """The outputs.

    Attributes:
        dictionary: the atoms.
        code: the patches.
    """

    dictionary: Dictionary
    code: SparseCode


@node(version=1)
def load_sparse(*, path: Annotated[InputPath, Param("File that sparse.save_sparse wrote.")]) -> Loaded:
    """Read a dictionary and a code from a file of sparse.save_sparse.

    The dictionary is of the kind that was saved: noise are functions again, an exemplar is a map with positions.

    Args:
        path: HDF5.

    Returns:
        ``dictionary`` and ``code``, equal to the bit to what was saved without quantisation.

    Raises:
        ValueError: the file is cut short or damaged, holds something else, or is of a newer version.
    """
    return Loaded(*unpacked(path, path.name))
