"""The file format of sparse terrains: HDF5, each array in as few bytes as hold it.

    attribute  format = "nodegraph-sparse/2"
    /dictionary        attribute form, and the fields of that form: arrays as datasets, others as attributes;
                       the parts of a merged dictionary are groups in it, numbered from 0
    /code              counts (n,) where not all patches have s atoms; indices and coefficients, those of all patches
                       one after the other; means (n,); residuals (n,).  Attributes metric, crs, unit (of the extent),
                       place (west, south, east, north; radius; west and north of the first centre), and
                       shape (rows, columns, s, N, samples along a side or 0)

Whole numbers take the smallest type that holds them.  Numbers of `bits` bits are stored as code * step + origin, both
attributes of their dataset.  All datasets are compressed and have checksums.  Residuals of quantised codes are
estimates, stored as root mean squares in float16.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from nodegraph_sparse.dictionary import Dictionary, SampledDictionary, SparseCode
from nodegraph_sparse.exemplar import ExemplarDictionary
from nodegraph_sparse.merge_dictionaries import MergedDictionary
from nodegraph_sparse.metric import Metric, columns, mass
from nodegraph_sparse.noise_dictionary import NoiseDictionary, NoiseKind
from nodegraph_sparse.patch_grid import PatchGrid
from nodegraph_sparse.pursuit_rules import Floats
from nodegraph_sparse.sparse_raster import reliefs
from nodegraph_terrain.raster import Extent

NAME, VERSION = "nodegraph-sparse", 2

FORMS: dict[str, type[Dictionary]] = {
    "samples": SampledDictionary,
    "map": ExemplarDictionary,
    "noise": NoiseDictionary,
    "merged": MergedDictionary,
}
"""Names in files.  Their fields are part of the format: where one changes, so must `VERSION`."""

SINCE_2 = frozenset({"cell"})
"""Fields that files of version 1 do not have; their defaults say that nothing is known."""

HEIGHTS = frozenset({"samples", "heights"})
"""Fields that quantised atoms are stored in fewer bits of."""

CHUNK = 1 << 18
"""Numbers that are compressed together."""


@dataclass(frozen=True, slots=True)
class Precision:
    """Bits of a stored number, 2 to 16; none: as it is."""

    coefficients: int | None = None
    means: int | None = None
    atoms: int | None = None

    @property
    def exact(self) -> bool:
        """Say whether nothing is lost."""
        return self.coefficients is self.means is self.atoms is None


def packed(dictionary: Dictionary, code: SparseCode, precision: Precision = Precision()) -> bytes:
    """Return a dictionary and a code as the bytes of a file.

    Raises:
        ValueError: the code is not one of this dictionary, or the dictionary is of a kind without a form in files.
    """
    if code.atoms != dictionary.count:
        raise ValueError(
            f"the code is one of {code.atoms} atoms and the dictionary has {dictionary.count}; link the dictionary "
            "that the code was made with"
        )
    if code.metric != dictionary.metric:
        raise ValueError(f"the code is of the {code.metric} metric and the dictionary of the {dictionary.metric} one")
    import h5py

    buffer = BytesIO()
    with h5py.File(buffer, "w", libver="v110") as file:
        file.attrs["format"] = _fixed(f"{NAME}/{VERSION}")
        parts = file.create_group("dictionary"), file.create_group("code")
        _put_dictionary(parts[0], dictionary, precision)
        _put_code(parts[1], code, precision)
        if precision.exact:
            _put(parts[1], "residuals", code.residuals)
        else:
            changed = _moved(dictionary, code, _dictionary(parts[0]), _code(parts[1]))
            each = np.sqrt((code.residuals + changed) / _samples(dictionary.size, code.metric))
            _put(parts[1], "residuals", each.astype(np.float16))
    return buffer.getvalue()


def _moved(dictionary: Dictionary, code: SparseCode, coarse: Dictionary, coarse_code: SparseCode) -> Floats:
    """Return by how much quantising changes each patch, squared in the metric.

    What least squares leave is orthogonal to the atoms, so that this adds to the residual.
    """
    changed = np.empty(code.grid.count)
    pairs = zip(reliefs(dictionary, code), reliefs(coarse, coarse_code), strict=True)
    for (part, before), (_, after) in pairs:
        after += (coarse_code.means - code.means)[part, None, None] - before
        vectors = columns(after, code.metric)
        changed[part] = np.einsum("ij,ij->i", vectors, vectors)
    return changed


def _samples(size: int, metric: Metric) -> float:
    return float(mass(size, metric).sum())


def unpacked(source: Path | bytes, name: str) -> tuple[Dictionary, SparseCode]:
    """Return what a file holds.

    Args:
        source: the file, or its bytes.
        name: for messages.

    Raises:
        ValueError: the file is damaged, of another kind, or of a newer version.
    """
    import h5py

    try:
        file = h5py.File(BytesIO(source) if isinstance(source, bytes) else source, "r")
    except OSError:
        raise ValueError(f"'{name}' is no complete HDF5 file; it may be cut short, or something else") from None
    with file:
        kind, _, version = _text(file.attrs.get("format", "")).partition("/")
        if kind != NAME:
            raise ValueError(f"'{name}' holds no sparse terrain; give a file that sparse.save_sparse wrote")
        if not version.isdigit() or int(version) > VERSION:
            raise ValueError(f"'{name}' is of version {version} and this program reads {VERSION}; update nodegraph")
        try:
            dictionary = _dictionary(file["dictionary"])
            code = _with_residuals(_code(file["code"]), _get(file["code"], "residuals"), dictionary.size)
            fits = (code.atoms, code.metric) == (dictionary.count, dictionary.metric)
        except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError):
            fits = False
        if not fits:
            raise ValueError(f"'{name}' is damaged; save it again with sparse.save_sparse")
    return dictionary, code


def _put(group: Any, name: str, array: npt.NDArray[Any], bits: int | None = None) -> None:
    stored = array
    notes: dict[str, Any] = {}
    if array.dtype.kind in "iu":
        notes["dtype"] = _fixed(array.dtype.str)
        ends = (int(array.min()), int(array.max())) if array.size else (0, 0)
        stored = array.astype(np.promote_types(*map(np.min_scalar_type, ends)))
    elif bits is not None and array.size:
        low, high = float(array.min()), float(array.max())
        step = (high - low) / (2**bits - 1) or 1.0
        stored = np.rint((array.astype(np.float64) - low) / step).astype(np.uint8 if bits <= 8 else np.uint16)
        notes |= {"dtype": _fixed(array.dtype.str), "step": step, "origin": low}
    filters: dict[str, Any] = {}
    if array.size:
        rows = max(1, CHUNK * len(array) // array.size)
        filters = {"chunks": (min(rows, len(array)), *array.shape[1:]), "compression": "gzip", "compression_opts": 9}
        filters |= {"shuffle": True, "fletcher32": True}
    dataset = group.create_dataset(name, data=stored, track_times=False, **filters)
    dataset.attrs.update(notes)


def _get(group: Any, name: str) -> npt.NDArray[Any]:
    dataset = group[name]
    array: npt.NDArray[Any] = dataset[()]
    if "step" in dataset.attrs:
        array = array * float(dataset.attrs["step"]) + float(dataset.attrs["origin"])
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name} is not finite")
    return array.astype(_text(dataset.attrs["dtype"])) if "dtype" in dataset.attrs else array


def _put_dictionary(group: Any, dictionary: Dictionary, precision: Precision) -> None:
    form = next((name for name, cls in FORMS.items() if type(dictionary) is cls), None)
    if form is None:
        raise ValueError(f"a {type(dictionary).__name__} has no form in files; {', '.join(FORMS)} have")
    group.attrs["form"] = _fixed(form)
    for name, value in _values(dictionary):
        if isinstance(value, np.ndarray):
            _put(group, name, value, precision.atoms if name in HEIGHTS else None)
        elif name == "parts":
            for number, part in enumerate(value):
                _put_dictionary(group.create_group(str(number)), part, precision)
        else:
            group.attrs[name] = value if isinstance(value, (int, float)) else _fixed(value)


def _dictionary(group: Any) -> Dictionary:
    cls = FORMS[_text(group.attrs["form"])]
    values: dict[str, Any] = {}
    for item in fields(cls):
        if item.name == "names":
            values["names"] = tuple(_text(name) for name in group.attrs["names"])
        elif item.name == "parts":
            numbers = sorted(int(name) for name in group if name.isdigit())
            values["parts"] = tuple(_dictionary(group[str(number)]) for number in numbers)
        elif item.name in group:
            values[item.name] = _get(group, item.name)
        elif item.name in group.attrs or item.name not in SINCE_2:
            value = group.attrs[item.name]
            plain = float if isinstance(value, float) else int
            values[item.name] = _text(value) if isinstance(value, bytes) else plain(value)
    dictionary = cls(**values)
    lengths = {len(value) for name, value in values.items() if isinstance(value, np.ndarray) and name != "heights"}
    if len(lengths) != 1:
        raise ValueError("fields of different lengths")
    if isinstance(dictionary, NoiseDictionary) and dictionary.kind not in get_args(NoiseKind):
        raise ValueError("no such noise")
    dictionary.atoms(slice(0, min(1, dictionary.count)))
    return dictionary


def _values(dictionary: Dictionary) -> Iterator[tuple[str, Any]]:
    return ((item.name, getattr(dictionary, item.name)) for item in fields(dictionary))


def _put_code(group: Any, code: SparseCode, precision: Precision) -> None:
    grid, extent = code.grid, code.grid.extent
    # Few attributes: HDF5 takes kilobytes for more than eight.
    group.attrs["place"] = [extent.west, extent.south, extent.east, extent.north, grid.radius, grid.west, grid.north]
    group.attrs["crs"], group.attrs["unit"] = _fixed(extent.crs), _fixed(extent.unit)
    group.attrs["shape"] = [grid.rows, grid.cols, code.sparsity, code.atoms, code.size or 0]
    group.attrs["metric"] = _fixed(code.metric)
    used = code.indices >= 0
    if not used.all():
        _put(group, "counts", used.sum(axis=1))
    _put(group, "indices", code.indices[used])
    _put(group, "coefficients", code.coefficients[used], precision.coefficients)
    _put(group, "means", code.means, precision.means)


def _code(group: Any) -> SparseCode:
    west, south, east, north, radius, first_west, first_north = map(float, group.attrs["place"])
    rows, cols, sparsity, atoms, size = map(int, group.attrs["shape"])
    extent = Extent(west, south, east, north, _text(group.attrs["crs"]), _text(group.attrs["unit"]))
    grid = PatchGrid(extent, radius, first_west, first_north, rows, cols)
    shape = grid.count, sparsity
    used = np.ones(shape, np.bool_)
    if "counts" in group:
        used = np.arange(shape[1]) < _get(group, "counts")[:, None]
    indices, coefficients = np.full(shape, -1, np.int32), np.zeros(shape)
    indices[used], coefficients[used] = _get(group, "indices"), _get(group, "coefficients")
    metric: Any = _text(group.attrs["metric"])
    if metric not in ("weighted", "plain") or indices.min(initial=0) < -1 or (indices[used] < 0).any():
        raise ValueError("impossible numbers")
    none = np.zeros(grid.count)
    return SparseCode(grid, indices, coefficients, _get(group, "means"), none, atoms, metric, size or None)


def _with_residuals(code: SparseCode, stored: npt.NDArray[Any], size: int) -> SparseCode:
    if stored.dtype == np.float16:
        stored = stored.astype(np.float64) ** 2 * _samples(size, code.metric)
    return replace(code, residuals=stored)


def _fixed(text: str | tuple[str, ...]) -> npt.NDArray[Any]:
    """Return texts as UTF-8 of fixed length: HDF5 takes four kilobytes for the first one of variable length."""
    import h5py

    words = np.char.encode(np.asarray(text, np.str_), "utf-8")
    return words.astype(h5py.string_dtype("utf-8", max(1, words.dtype.itemsize)))


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
