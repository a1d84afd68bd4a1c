import threading

import numpy as np
import pyopencl as cl
import pytest

from nodegraph.errors import DeviceError
from nodegraph.opencl import Local


@pytest.fixture
def arrays(device):
    return device.from_host(np.arange(8, dtype=np.float32)), device.empty(8)


def test_a_kernel_gives_the_same_shared_and_copied(device, kernels):
    rng = np.random.default_rng(3)
    array = rng.normal(size=(37, 53)).astype(np.float32)
    out = device.empty((53, 37))
    device.run(kernels, "transpose", (53, 37), device.from_host(array), out)
    assert np.array_equal(device.to_host(out), array.T)


def test_a_chain_needs_no_waiting(device, kernels):
    value = device.from_host(np.ones(1000, np.float32))
    for _ in range(20):
        out = device.empty_like(value)
        device.run(kernels, "scale", 1000, value, out, 2, 1000)
        value = out
    assert (device.to_host(value) == 2.0**20).all()


def test_vectors_local_memory_and_null_pointers(device, kernels):
    out = device.empty(4)
    device.run(kernels, "tilt", 4, out, (1, 2, 3), Local(2), None, local_size=2)
    assert (device.to_host(out) == 321).all()
    mask = device.from_host(np.array([2], np.float32))
    device.run(kernels, "tilt", 4, out, np.array([1, 0, 0], np.float32), Local(4), mask)
    assert (device.to_host(out) == 2).all()


def test_booleans_count_as_chars_and_complex_as_pairs(device, kernels):
    flags = device.from_host(np.array([True, False, True]))
    waves = device.from_host(np.array([1 + 10j, 2 + 20j, 3 + 30j], np.complex64))
    out = device.empty(3, np.int32)
    device.run(kernels, "count", 3, flags, waves, out, -1)
    assert device.to_host(out).tolist() == [9, 20, 29]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({2: "x"}, r"argument 'factor' \(float\) got a str, expected a number for float32"),
        ({2: np.float64(1)}, r"'factor' \(float\) got numpy.float64\(1.0\), expected numpy.float32 or a Python number"),
        ({2: 1e39}, r"'factor' \(float\) got 1e\+39, which does not fit float32"),
        ({2: (1, 2)}, "got 2 numbers, expected 1"),
        ({2: None}, "got a NoneType, expected a number"),
        ({2: Local(4)}, "only a __local pointer takes"),
        ({3: 8.0}, r"'n' \(uint\) got float 8.0, expected a number for uint32"),
        ({3: -1}, r"'n' \(uint\) got -1, which does not fit uint32"),
        ({3: 1 << 32}, "does not fit uint32"),
        ({0: np.ones(8, np.float32)}, "put it on the device first with device.from_host"),
        ({0: 3}, r"'a' \(float\*\) got int 3; give a device array"),
    ],
)
def test_an_argument_that_does_not_fit(device, kernels, arrays, change, says):
    args = [*arrays, 2.0, 8]
    for index, value in change.items():
        args[index] = value
    with pytest.raises(DeviceError, match=says) as caught:
        device.run(kernels, "scale", 8, *args)
    assert str(caught.value).startswith("kernel 'scale' (kernels.cl): argument ")


def test_infinity_is_a_number(device, kernels, arrays):
    device.run(kernels, "scale", 8, *arrays, float("inf"), np.uint32(8))
    assert np.isinf(device.to_host(arrays[1])[1:]).all()


def test_arrays_that_do_not_fit(device, kernels, arrays):
    given, out = arrays
    wrong = {
        "got an array of dtype int32, expected float32": device.zeros(8, np.int32),
        r"is a view with strides \(8,\)": device.zeros(16)[::2],
        "starts inside its buffer": device.zeros(16)[8:],
    }
    for says, array in wrong.items():
        with pytest.raises(DeviceError, match=says):
            device.run(kernels, "scale", 8, array, out, 1.0, 8)
    with pytest.raises(DeviceError, match=r"takes 4 arguments \(a, out, factor, n\), got 2"):
        device.run(kernels, "scale", 8, given, out)
    with pytest.raises(DeviceError, match=r"float3.*got 2 numbers, expected 3"):
        device.run(kernels, "tilt", 8, out, (1, 2), Local(1), None)
    with pytest.raises(DeviceError, match=r"'scratch'.*give a Local"):
        device.run(kernels, "tilt", 8, out, (1, 2, 3), 5, None)


def test_arrays_stay_on_their_device(shared, copying, kernels):
    with pytest.raises(DeviceError, match=r"'a'.*on another device"):
        shared.run(kernels, "scale", 8, copying.zeros(8), shared.zeros(8), 1.0, 8)


def test_inputs_are_not_written(device, kernels):
    array = np.ones(8, np.float32)
    given = device.from_host(array)
    with pytest.raises(DeviceError, match=r"argument 'out' \(float\*\) is not const and got an array from the host"):
        device.run(kernels, "scale", 8, given, given, 2.0, 8)
    device.finish()
    assert (array == 1).all()


def test_nothing_to_do(device, kernels, arrays):
    device.run(kernels, "scale", 0, *arrays, 1.0, 8).wait()
    device.run(
        kernels, "transpose", (0, 5), device.from_host(np.zeros((5, 0), np.float32)), device.empty((0, 5))
    ).wait()


@pytest.mark.parametrize(
    ("size", "group", "says"),
    [
        (100, 16, r"global size \(100,\) is no multiple of local size \(16,\); launch \(112,\)"),
        ((8, 8), 8, "local size 8 must be 2 positive numbers"),
        (8, 0, "must be 1 positive numbers"),
        (-1, None, "one to three numbers, none negative"),
        ((), None, "one to three numbers"),
        ((1, 1, 1, 1), None, "one to three numbers"),
    ],
)
def test_sizes_that_make_no_sense(shared, kernels, size, group, says):
    out = shared.empty(8)
    with pytest.raises(DeviceError, match=says):
        shared.run(kernels, "slow", size, out, 1, local_size=group)


def test_a_launch_that_the_driver_refuses(shared, kernels):
    too_many = 2 * cl.Device.from_int_ptr(shared.context.devices[0].int_ptr).max_work_group_size
    with pytest.raises(DeviceError) as caught:
        shared.run(kernels, "slow", too_many, shared.empty(too_many), 1, local_size=too_many)
    text = str(caught.value)
    assert text.startswith(
        f"OpenCL device '{shared.info.name}' could not run kernel 'slow' (kernels.cl): INVALID_WORK_"
    )
    assert text.endswith("; give a smaller local size, or none")


def test_a_device_that_fails_while_it_works(shared, monkeypatch):
    def fail(*args, **kwargs):
        cl.Buffer(shared.context, cl.mem_flags.READ_WRITE, 1 << 60)  # any error of the driver's

    class Queue:
        finish = fail

    monkeypatch.setattr(shared, "queue", Queue())
    with pytest.raises(DeviceError, match="could not finish its work: INVALID_BUFFER_SIZE"):
        shared.finish()


def test_defines_belong_to_the_file(shared, kernels):
    with pytest.raises(DeviceError, match="compiled already"):
        shared.run(shared.program(kernels), "slow", 1, shared.empty(1), 1, defines={"A": 1})


def test_timings(shared, kernels):
    out = shared.empty(1000)
    given = shared.from_host(np.ones(1000, np.float32))
    shared.run(kernels, "scale", 1000, given, out, 1.0, 1000)
    with shared.timings() as outer:
        for _ in range(5):
            shared.run(kernels, "scale", 1000, given, out, 1.0, 1000)
        with shared.timings() as inner:
            worker = threading.Thread(target=lambda: shared.run(kernels, "slow", 2, out, 500_000))
            worker.start()
            worker.join()
    shared.run(kernels, "scale", 1000, given, out, 1.0, 1000)
    rows = {row.kernel: row for row in outer.rows()}
    assert {name: row.count for name, row in rows.items()} == {"scale": 5, "slow": 1}
    assert [row.kernel for row in outer.rows()] == ["slow", "scale"], "the most expensive first"
    assert [row.kernel for row in inner.rows()] == ["slow"]
    scale = rows["scale"]
    assert 0 < scale.min <= scale.median <= scale.max <= scale.total < rows["slow"].total < 10
    assert scale.file == "kernels.cl"
    lines = str(outer).splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [["kernels.cl:slow", "1"], ["kernels.cl:scale", "5"]]
    assert len(set(map(len, lines))) == 1, "the columns line up"


def test_long_runs_keep_no_events(shared, kernels, monkeypatch):
    monkeypatch.setattr("nodegraph.opencl.timings._UNSETTLED", 10)
    out = shared.empty(2)
    with shared.timings() as timings:
        for _ in range(25):
            shared.run(kernels, "slow", 2, out, 1)
            assert len(timings._pending) < 10
    assert timings.rows()[0].count == 25
