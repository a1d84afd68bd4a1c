import dataclasses
import gc
import weakref

import hypothesis.extra.numpy as hnp
import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph.errors import DeviceError
from nodegraph.opencl import Device, buffers

DTYPES = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(endianness="?"),
    hnp.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
    hnp.complex_number_dtypes(endianness="?", sizes=(64, 128)),
)
ARRAYS = DTYPES.flatmap(
    lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5))
)


def same(a, b):
    return (
        a.shape == b.shape
        and a.dtype == b.dtype.newbyteorder("=")
        and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    )


@settings(max_examples=150, deadline=None)
@given(array=ARRAYS, view=st.sampled_from(["", "T", "[::-1]", "[1:]", "[..., ::2]"]), sealed=st.booleans())
def test_every_array_comes_back_as_it_went(device, array, view, sealed):
    if array.ndim:
        array = eval(f"array.{view}" if view == "T" else f"array{view}")
    array.flags.writeable = not sealed
    on_device = device.from_host(array)
    assert on_device.shape == array.shape
    assert on_device.flags.c_contiguous or not array.size
    back = device.to_host(on_device)
    assert same(back, array)


@settings(max_examples=50, deadline=None)
@given(array=ARRAYS.filter(lambda array: array.size))
def test_results_come_back_as_they_are(device, array):
    array = array.astype(array.dtype.newbyteorder("="))
    out = device.empty_like(array)
    cl.enqueue_copy(device.queue, out.base_data, array.copy())
    assert same(device.to_host(out), array)


@pytest.mark.parametrize("index", [np.s_[2:], np.s_[1:3, 2:5], np.s_[:, 3], np.s_[::2]])
def test_views_of_device_arrays_come_back_as_views(device, index):
    array = np.arange(42, dtype=np.float32).reshape(6, 7)
    result = device.from_host(array) + np.float32(1)
    assert same(device.to_host(result[index]), array[index] + 1)
    assert same(device.to_host(device.from_host(array)[index]), array[index])


def test_shared_memory_is_not_copied(shared, kernels):
    array = np.arange(1000, dtype=np.float32)
    array.flags.writeable = False
    given_ = shared.from_host(array)
    assert np.shares_memory(given_.base_data.host, array)
    assert shared.to_host(given_) is array

    out = shared.empty_like(given_)
    before = shared.to_host(out)
    shared.run(kernels, "scale", 1000, given_, out, 2.0, 1000)
    after = shared.to_host(out)
    assert np.shares_memory(before, after)
    assert np.array_equal(before, 2 * array)
    assert np.shares_memory(shared.to_host(out[10:20]), after[10:20])
    assert before.ctypes.data % 64 == 0


def test_a_window_is_shared_where_it_lies(shared):
    whole = np.arange(100, dtype=np.float32)
    window = whole[3:50]
    assert np.shares_memory(shared.to_host(shared.from_host(window)), window)


def test_copies_are_copies(copying):
    array = np.arange(10, dtype=np.float32)
    given_ = copying.from_host(array)
    back = copying.to_host(given_)
    assert not np.shares_memory(back, array)
    array[:] = 0
    assert copying.to_host(given_)[9] == 9


def test_a_sealed_array_is_found_again_instead_of_being_read_back(copying):
    array = np.arange(10, dtype=np.float32)
    array.flags.writeable = False
    given_ = copying.from_host(array)
    assert copying.to_host(given_) is array
    expected, reference = array.copy(), weakref.ref(array)
    del array
    assert reference() is None, "the device array keeps the host array alive"
    assert np.array_equal(copying.to_host(given_), expected)


def test_the_host_array_lives_as_long_as_it_is_shared(shared):
    array = np.full(100_000, 7, np.float32)
    reference = weakref.ref(array)
    given_ = shared.from_host(array)
    del array
    assert reference() is not None
    assert (shared.to_host(given_ + np.float32(1)) == 8).all()
    del given_
    gc.collect()
    shared.finish()
    assert reference() is None


def test_results_outlive_their_device_array(shared, kernels):
    out = shared.empty(1000)
    shared.run(kernels, "scale", 1000, shared.from_host(np.ones(1000, np.float32)), out, 3.0, 1000)
    result = shared.to_host(out)
    del out
    shared.finish()
    shared.zeros(1000)
    assert (result == 3).all()


def test_memory_is_kept_while_a_kernel_writes_it(shared, kernels):
    shared.program(kernels)
    out = shared.empty(2)
    memory = weakref.ref(out.base_data.host)
    event = shared.run(kernels, "slow", 2, out, 4_000_000)
    del out
    gc.collect()
    assert event.command_execution_status > 0, "the kernel was too quick to tell"
    assert memory() is not None
    shared.finish()
    assert memory() is None


def test_zeros(device):
    for shape in (0, 5, (2, 3), (4, 0)):
        array = device.zeros(shape, np.int32)
        assert (device.to_host(array) == np.zeros(shape, np.int32)).all()
        assert device.to_host(array).shape == np.zeros(shape).shape
    assert device.empty((3, 4)).dtype == np.float32


def test_bytes_are_counted_while_they_live(device):
    device.finish()
    before = device.bytes_alive
    first = device.empty((1000, 1000))
    second = first + np.float32(1)  # an operator's result is memory of the device too
    assert device.bytes_alive == before + 8_000_000
    view = first[10:20]
    del first
    device.finish()
    assert device.bytes_alive == before + 8_000_000, "the view keeps the whole"
    del view, second
    device.finish()
    assert device.bytes_alive == before


def test_shared_host_arrays_do_not_count_and_copies_do(shared, copying):
    array = np.ones((100, 100), np.float32)
    for device, view, counted in ((shared, array, 0), (shared, array.T[::2], 20_000), (copying, array, 40_000)):
        device.finish()
        before = device.bytes_alive
        held = device.from_host(view)
        assert device.bytes_alive - before == counted
        assert held.shape == view.shape


def test_the_largest_allocation_is_refused_before_it_is_tried(device):
    limit = device.info.largest_allocation
    with pytest.raises(DeviceError, match=r"takes arrays of up to .* and was asked for .*; use smaller data") as caught:
        device.empty(limit + 1, np.uint8)
    assert buffers.size_text(limit) in str(caught.value)


def test_a_full_device_is_refused_naming_both_sizes(copying):
    small = Device(dataclasses.replace(copying.info, memory=10_000_000), unified=False)
    held = small.empty(2_000_000)
    with pytest.raises(DeviceError) as caught:
        small.empty(1_000_000)
    assert str(caught.value) == (
        f"OpenCL device '{small.info.name}' has 2 MB of memory left and was asked for 4 MB; "
        "use smaller data or another device"
    )
    with pytest.raises(DeviceError, match="2 MB of memory left"):
        small.from_host(np.zeros(1_000_000, np.float32))
    assert small.bytes_alive == 8_000_000
    del held
    assert small.empty(1_000_000).size == 1_000_000


def test_room_is_waited_for(copying, kernels):
    small = Device(dataclasses.replace(copying.info, memory=10_000_000), unified=False)
    out = small.empty(2_000_000)
    small.run(kernels, "slow", 2, out, 1_000_000)
    del out  # still written by the kernel
    assert small.empty(2_000_000).size == 2_000_000


def test_a_full_host_is_refused(shared, monkeypatch):
    monkeypatch.setattr(buffers, "host_memory_left", lambda: 30_000_000)
    assert shared.empty(20_000_000, np.uint8).size == 20_000_000
    with pytest.raises(DeviceError, match="has 30 MB of memory left and was asked for 40 MB"):
        shared.empty(40_000_000, np.uint8)
    # What the caller holds already takes nothing.
    assert shared.from_host(np.zeros(40_000_000, np.uint8)).size == 40_000_000


def test_host_memory_left_is_plausible():
    assert 1 << 20 < buffers.host_memory_left() < 1 << 50


def test_a_driver_that_refuses_memory(copying):
    # The device claims more than it has, so that only the driver can say no.
    boastful = Device(dataclasses.replace(copying.info, memory=1 << 60, largest_allocation=1 << 60), unified=False)
    with pytest.raises(
        DeviceError, match=r"could not allocate .*INVALID_BUFFER_SIZE; use smaller data or another device"
    ):
        boastful.empty(1 << 45, np.uint8)
    assert boastful.bytes_alive == 0


@pytest.mark.parametrize("array", [np.array(["a"]), np.array(["2020-01-01"], "M8[D]"), np.zeros(2, np.longdouble)])
def test_arrays_without_an_opencl_type(device, array):
    assert not device.accepts(array.dtype)
    with pytest.raises(DeviceError, match="OpenCL has no type for an array of dtype"):
        device.from_host(array)


def test_arrays_of_others_come_back_too(device):
    array = np.arange(12, dtype=np.float32).reshape(3, 4)
    foreign = cla.to_device(device.queue, array)
    assert np.array_equal(buffers.to_host(foreign), array)
    assert np.array_equal(buffers.to_host(foreign[:, 1]), array[:, 1])
