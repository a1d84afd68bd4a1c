"""The codec: any value comes back equal, equal values have equal digests, and different ones different digests."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from nodegraph import codec, port_type
from nodegraph.cache.store import ValueStore
from nodegraph.porttypes import key_of


@port_type
class Leaf:
    """One of everything."""

    array: np.ndarray
    number: Any = 0.0
    text: str = ""


@port_type
class Pair:
    """Two of anything."""

    left: Any
    right: Any


@port_type
class Riap:
    """The same fields under another name."""

    left: Any
    right: Any


@port_type
class Other:
    """Fields of other names."""

    left: Any
    wrong: Any


@port_type
class Empty:
    """Nothing."""


def arrays(max_side: int = 4) -> st.SearchStrategy[np.ndarray]:
    kinds = st.one_of(
        nps.boolean_dtypes(),
        nps.integer_dtypes(endianness="?"),
        nps.unsigned_integer_dtypes(endianness="?"),
        nps.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
        nps.complex_number_dtypes(endianness="?", sizes=(64, 128)),
        nps.datetime64_dtypes(endianness="?"),
        nps.timedelta64_dtypes(endianness="?"),
        nps.byte_string_dtypes(endianness="?", max_len=5),
        nps.unicode_string_dtypes(endianness="?", max_len=5),
        st.sampled_from([np.dtype(np.longdouble), np.dtype(np.clongdouble)]),
    )
    return kinds.flatmap(
        lambda kind: nps.arrays(kind, nps.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=max_side))
    )


scalars = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(-(2**200), 2**200)
    | st.floats()
    | st.text()
    | st.text(st.characters(min_codepoint=0xD700, max_codepoint=0xE000))
    | st.binary(max_size=20)
    | st.just(-0.0)
)
values = st.recursive(
    scalars | arrays(),
    lambda inner: (
        st.builds(Leaf, arrays(), scalars, st.text())
        | st.builds(Pair, inner, inner)
        | inner.map(lambda item: Pair(item, item))
        | st.lists(inner, max_size=3).map(tuple)
        | st.builds(Empty)
    ),
    max_leaves=8,
)


def same(a: Any, b: Any) -> bool:
    """Say whether two values are equal in every bit that counts: types, dtypes, shapes, NaN."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        if (a.dtype.str, a.shape) != (b.dtype.str, b.shape):
            return False
        if a.dtype.kind in "fc":
            return bool(np.array_equal(a, b, equal_nan=True)) and bool((np.signbit(a.real) == np.signbit(b.real)).all())
        return a.tobytes() == b.tobytes()
    if isinstance(a, float):
        return (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a))
    return bool(a == b)


@settings(max_examples=200)
@given(value=values)
def test_any_value_comes_back_equal(value: Any) -> None:
    digest = codec.seal(value)
    again = codec.decode(codec.encode(value))
    assert same(again, value)
    assert codec.seal(again) == digest


@settings(max_examples=60)
@given(value=values)
def test_any_value_comes_back_from_a_file(tmp_path_factory: pytest.TempPathFactory, value: Any) -> None:
    store = ValueStore(tmp_path_factory.getbasetemp() / "values")
    digest = codec.seal(value)
    store.write(digest, value)
    again = store.read(digest)
    assert same(again, value)
    assert codec.seal(again) == digest
    store.remove(digest)


@pytest.mark.parametrize(
    "kind",
    [
        "?",
        "i1",
        "<u2",
        ">u2",
        "<i8",
        ">i8",
        "<f2",
        ">f2",
        "<f4",
        ">f4",
        "<f8",
        ">f8",
        "<c8",
        ">c16",
        "<M8[s]",
        ">m8[25us]",
        "<U7",
        ">U7",
        "S5",
        "g",
        "G",
    ],
)
@pytest.mark.parametrize("shape", [(), (0,), (3, 0, 2), (1,), (70, 90), (3, 40, 50)])
def test_large_and_small_arrays_of_every_kind(tmp_path: Path, kind: str, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    dtype = np.dtype(kind)
    if dtype.kind in "US":
        array = rng.integers(0, 10**4, shape).astype(dtype)
    elif dtype.kind in "Mm":
        array = rng.integers(-(10**9), 10**9, shape).astype("<i8").view(f"<{dtype.str[1:]}").astype(dtype)
    else:
        array = np.asarray(rng.normal(size=shape) * 100).astype(dtype)
    value = Pair(array, array[..., ::-1] if array.ndim else array)
    digest = codec.seal(value)
    store = ValueStore(tmp_path)
    store.write(digest, value)
    again = store.read(digest)
    assert same(again, value)
    assert codec.seal(again) == digest
    assert not again.left.flags.writeable
    assert not again.right.flags.writeable


@given(array=arrays(), data=st.data())
def test_memory_layout_does_not_count(array: np.ndarray, data: Any) -> None:
    digest = codec.seal(array.copy())
    assert codec.seal(np.array(array, order="F")) == digest
    if array.ndim:
        padded = np.zeros(tuple(2 * side + 1 for side in array.shape), array.dtype)
        window = padded[tuple(slice(1, None, 2) for _ in array.shape)]
        window[...] = array
        assert codec.seal(window) == digest
    if array.ndim > 1:
        axes = data.draw(st.permutations(range(array.ndim)))
        assert codec.seal(np.ascontiguousarray(array.transpose(axes)).transpose(np.argsort(axes))) == digest


def test_padding_inside_long_doubles_does_not_count() -> None:
    clean = np.zeros(4, np.longdouble)
    clean[:] = [np.longdouble(index) / 3 for index in range(4)]
    scrambled = clean.copy()
    raw = scrambled.view(np.uint8).reshape(4, -1)
    if np.finfo(np.longdouble).nmant == 63:  # x86: 80 bits in 16 bytes
        raw[:, 10:] = 0xAB
    assert np.array_equal(clean, scrambled)
    assert codec.seal(clean) == codec.seal(scrambled)
    assert codec.seal(clean + 0j) == codec.seal(scrambled + 0j)


@settings(max_examples=200)
@given(a=values, b=values)
@example(a=1, b=1.0)
@example(a=1, b=True)
@example(a=0, b=False)
@example(a=0.0, b=-0.0)
@example(a=None, b="")
@example(a="1", b=1)
@example(a="ab", b=b"ab")
@example(a=(), b=None)
@example(a=((),), b=())
@example(a=((1,), 2), b=(1, (2,)))
@example(a=("a", "b"), b=("ab",))
@example(a=("a\0", "b"), b=("a", "\0b"))
@example(a=Pair(1, 2), b=Riap(1, 2))
@example(a=Pair(1, 2), b=Other(1, 2))
@example(a=Pair(1, 2), b=Pair(2, 1))
@example(a=Pair(1, 2), b=(1, 2))
@example(a=Empty(), b=())
@example(a=np.zeros(4), b=np.zeros((2, 2)))
@example(a=np.zeros((2, 0)), b=np.zeros((0, 2)))
@example(a=np.zeros(2, "f4"), b=np.zeros(1, "f8"))
@example(a=np.zeros(2, "f4"), b=np.zeros(2, "i4"))
@example(a=np.zeros(2, "<f4"), b=np.zeros(2, ">f4"))
@example(a=np.zeros(2, "<M8[s]"), b=np.zeros(2, "<M8[ms]"))
@example(a=np.zeros(()), b=0.0)
@example(a=np.zeros(1), b=np.zeros(()))
@example(a=np.array(["a"]), b=np.array(["a"], "U2"))
@example(a=-1, b="-1")
@example(a=255, b=-255)
def test_different_values_have_different_digests(a: Any, b: Any) -> None:
    assert (codec.seal(a) == codec.seal(b)) == same(a, b)


def test_every_element_and_field_counts() -> None:
    base = Leaf(np.arange(12.0).reshape(3, 4), 1.0, "t")
    digests = {codec.seal(base)}
    for index in range(12):
        changed = np.arange(12.0).reshape(3, 4)
        changed.flat[index] = np.nextafter(changed.flat[index], 100)
        digests.add(codec.seal(Leaf(changed, 1.0, "t")))
    digests |= {codec.seal(Leaf(base.array, 2.0, "t")), codec.seal(Leaf(base.array, 1.0, "u"))}
    assert len(digests) == 15


def test_sharing_does_not_count_and_is_kept() -> None:
    array = np.arange(3000.0)
    shared = Pair(Pair(array, array), (array, Leaf(array)))
    apart = Pair(Pair(array.copy(), array.copy()), (array.copy(), Leaf(array.copy())))
    assert codec.seal(shared) == codec.seal(apart)
    encoded = codec.encode(apart)
    assert len(encoded.arrays) == 1
    again = codec.decode(encoded)
    assert again.left.left is again.left.right is again.right[0] is again.right[1].array
    assert codec.nbytes(shared) < 2 * array.nbytes
    assert codec.nbytes(apart) > 4 * array.nbytes


def test_an_instanced_tree_is_stored_once(tmp_path: Path) -> None:
    tree: Any = Leaf(np.arange(1000.0))
    for _ in range(60):
        tree = Pair(tree, tree)
    store = ValueStore(tmp_path)
    digest = codec.seal(tree)
    assert store.write(digest, tree) < 50_000
    assert codec.seal(store.read(digest)) == digest


@pytest.mark.parametrize("kind", ["tuple", "object", "mixed"])
def test_five_thousand_levels_deep(tmp_path: Path, kind: str) -> None:
    value: Any = np.arange(3.0)
    for level in range(5000):
        value = (value,) if kind == "tuple" or (kind == "mixed" and level % 2) else Pair(value, level)
    digest = codec.seal(value)
    store = ValueStore(tmp_path)
    store.write(digest, value)
    again = store.read(digest)
    assert codec.seal(again) == digest
    assert codec.nbytes(again) > 5000


def test_arrays_become_read_only() -> None:
    a, b, c = np.zeros(3), np.zeros(3), np.zeros((4, 4))
    codec.seal(Pair((a, Leaf(b)), c[::2, 1]))
    for array in (a, b, c):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1


def test_arrays_on_loan_become_read_only_as_a_whole() -> None:
    whole = np.zeros(10)
    part = whole[2:5][::-1]
    codec.seal(part)
    with pytest.raises(ValueError, match="read-only"):
        whole[3] = 1


class Named(tuple):
    """A tuple by another name."""


@dataclasses.dataclass(frozen=True)
class Undeclared:
    """No port type."""

    x: float


@pytest.mark.parametrize(
    ("value", "name"),
    [
        (np.array([1, None], object), "array of dtype object"),
        (np.ma.array([1.0, 2.0], mask=[0, 1]), "MaskedArray"),
        (np.zeros(2, [("a", "f4"), ("b", "i4")]), "array of dtype"),
        ([1.0], "list"),
        ({"a": 1}, "dict"),
        ({1}, "set"),
        (1j, "complex"),
        (np.float64(1.0), "float64"),
        (Named((1,)), "Named"),
        (Undeclared(1.0), "Undeclared"),
        (object(), "object"),
        (len, "builtin_function_or_method"),
        (Path("x"), "PosixPath"),
    ],
)
@pytest.mark.parametrize("inside", [False, True])
def test_other_values_are_refused_by_name(value: Any, name: str, inside: bool) -> None:
    whole = Pair((1, value), 2) if inside else value
    with pytest.raises(TypeError, match=f"a value may not hold a ({name})"):
        codec.seal(whole)
    with pytest.raises(TypeError, match="a value may not hold"):
        codec.encode(whole)


def test_a_value_that_contains_itself_is_refused() -> None:
    loop = Pair(1, 2)
    object.__setattr__(loop, "left", (loop,))
    with pytest.raises(TypeError, match="must not contain itself"):
        codec.seal(loop)


json_like = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 5)
    | st.floats()
    | st.sampled_from(["a", "o", "t", "r", "f", "i", "s", "y", "Pair", "00", "left", "right"]),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["left", "right", "x"]), inner, max_size=2)
    ),
    max_leaves=10,
)


@settings(max_examples=300)
@given(structure=json_like)
@example(structure=[0, [["f", "00"]]])
@example(structure=[0, [["i", "zz"]]])
@example(structure=[0, [["o", "Pair", {"right": 1, "left": 2}]]])
@example(structure=[0, [["o", "Text", {}]]])
def test_rubbish_is_undecodable_and_nothing_else(structure: Any) -> None:
    with contextlib.suppress(codec.UndecodableError):
        codec.decode(codec.Encoded(structure, [np.zeros(2)]))


def test_a_type_that_changed_its_fields_is_undecodable() -> None:
    encoded = codec.encode(Pair(1, 2))
    structure = [encoded.structure[0], [["o", key_of(Other), {"left": 1, "right": 2}]]]
    with pytest.raises(codec.UndecodableError, match=r"Other' has other fields now"):
        codec.decode(codec.Encoded(structure, []))
    with pytest.raises(codec.UndecodableError, match="'Gone' is not declared here"):
        codec.decode(codec.Encoded([0, [["o", "Gone", {}]]], []))


def test_digests_are_the_same_in_every_process() -> None:
    """A digest names a file that other processes read: these three must never change by accident."""
    assert codec.seal(1.5).hex() == codec.seal(float("1.5")).hex()
    found = [codec.seal(value).hex() for value in (1.5, ("a", 2), np.arange(3, dtype="<f4"))]
    from tests.nodegraph.support import python

    code = """
        import numpy as np
        from nodegraph import codec
        print(*[codec.seal(value).hex() for value in (1.5, ("a", 2), np.arange(3, dtype="<f4"))])
    """
    assert python(code).split() == found
