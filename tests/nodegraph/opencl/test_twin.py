import numpy as np
import pyopencl.array as cla
import pytest

from nodegraph import port_type
from nodegraph.codec import seal
from nodegraph.opencl import is_on_device, to_device, to_host

made = []


@port_type
class OpenclTestGrid:
    """A grid that checks itself when it is made."""

    data: np.ndarray
    extent: tuple = (0.0, 1.0)

    def __post_init__(self):
        made.append(self)


@port_type
class OpenclTestPair(OpenclTestGrid):
    """A subclass that holds others."""

    left: object = None
    right: object = None
    name: str = ""


@pytest.fixture
def value():
    grid = OpenclTestGrid(np.arange(12, dtype=np.float32).reshape(3, 4))
    words = np.array(["a", "bc"])
    lines = (np.arange(6.0).reshape(3, 2), np.zeros((0, 2)), 4)
    return OpenclTestPair(grid.data, left=grid, right=(grid, lines, words, None, True), name="pair")


def test_there_and_back(device, value):
    digest = seal(value)
    count = len(made)
    there = to_device(value, device)
    assert is_on_device(there)
    assert not is_on_device(value)
    assert type(there) is OpenclTestPair
    assert type(there.left) is OpenclTestGrid
    assert isinstance(there.data, cla.Array)
    assert isinstance(there.right[1][1], cla.Array)
    assert (there.name, there.right[3], there.right[4], there.right[1][2]) == ("pair", None, True, 4)
    assert there.extent is value.extent
    back = to_host(there)
    assert not is_on_device(back)
    assert seal(back) == digest
    assert len(made) == count, "checked again what was checked when it was made"


def test_sharing_is_kept(device, value):
    there = to_device(value, device)
    assert there.data is there.left.data
    assert there.left is there.right[0]
    back = to_host(there)
    assert back.data is back.left.data
    assert back.left is back.right[0]


def test_what_has_no_opencl_type_stays(device, value):
    there = to_device(value, device)
    assert there.right[2] is value.right[2]
    for untouched in (3, "text", None, (1, ("a", 2.5)), np.array(["a"]), ()):
        assert to_device(untouched, device) is untouched
        assert to_host(untouched) is untouched
        assert not is_on_device(untouched)


def test_nothing_is_copied_on_shared_memory(shared, value):
    there = to_device(value, shared)
    assert np.shares_memory(there.data.base_data.host, value.data)
    assert to_host(there).data is value.data


def test_arrays_are_copied_elsewhere(copying, value):
    back = to_host(to_device(value, copying))
    assert np.array_equal(back.data, value.data)
    assert not np.shares_memory(back.data, value.data)


def test_what_is_there_stays_and_what_is_elsewhere_moves(shared, copying, value):
    there = to_device(value, shared)
    assert to_device(there, shared) is there
    moved = to_device(there, copying)
    assert moved.data.context == copying.context
    assert np.array_equal(to_host(moved).data, value.data)


def test_results_of_operators_travel_too(device):
    grid = to_device(OpenclTestGrid(np.ones((2, 3), np.float32)), device)
    result = to_host(OpenclTestGrid(2 * grid.data + grid.data))
    assert (result.data == 3).all()
    assert result.data.dtype == np.float32


def test_deep_and_wide_values(device):
    leaf = np.ones(3, np.float32)
    deep = (leaf,)
    for _ in range(20_000):
        deep = (deep, 1)
    shared_many_times = (leaf,)
    for _ in range(60):  # 2**60 paths, 61 parts
        shared_many_times = (shared_many_times, shared_many_times)
    for value in (deep, shared_many_times):
        there = to_device(value, device)
        assert is_on_device(there)
        back = to_host(there)
        while isinstance(back[0], tuple):
            back = back[0]
        assert (back[0] == 1).all()


def test_a_value_that_contains_itself(device):
    loop = OpenclTestPair(np.ones(1))
    object.__setattr__(loop, "left", (loop,))
    with pytest.raises(TypeError, match="must not contain itself"):
        to_device(loop, device)
    assert not is_on_device(loop)
