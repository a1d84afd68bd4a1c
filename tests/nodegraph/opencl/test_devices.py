import dataclasses
import subprocess
import sys
import threading

import pyopencl as cl
import pytest

from nodegraph.errors import DeviceError
from nodegraph.opencl import DeviceInfo, choose, devices, list_devices

WITHOUT_PYOPENCL = """
import sys
import nodegraph.opencl
from nodegraph.opencl import choose, is_on_device, list_devices, to_host
import numpy as np
value = (np.arange(3.0), "text")
assert not is_on_device(value) and to_host(value) is value
assert "pyopencl" not in sys.modules, "loaded before anyone asked for a device"
sys.modules["pyopencl"] = None  # importing it now raises ImportError
assert list_devices() == []
assert choose("auto") is None
assert choose("none") is None
try:
    choose("0:0")
except nodegraph.errors.DeviceError as error:
    assert str(error) == "there is no OpenCL device '0:0'; use 'auto', 'none'", error
else:
    raise AssertionError("chose a device that is not there")
"""


def info(identity, kind, memory):
    return DeviceInfo(identity, "p", f"device {identity}", kind, "OpenCL 3.0", "1", 4, memory, memory // 4, False)


@pytest.fixture
def pretend(monkeypatch):
    """Pretend to have other devices; opening one gives its info."""

    def install(*infos):
        monkeypatch.setattr(devices, "_physical", lambda: [(item, None) for item in infos])
        monkeypatch.setattr(devices, "_open", lambda info, handle: info)

    return install


def test_everything_works_without_pyopencl():
    done = subprocess.run([sys.executable, "-c", WITHOUT_PYOPENCL], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_driver_is_no_devices(monkeypatch):
    def fail():
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", fail)
    assert list_devices() == []
    assert choose("auto") is None


def test_a_platform_that_fails_is_left_out(monkeypatch):
    class Broken:
        def get_devices(self):
            raise cl.RuntimeError("clGetDeviceIDs failed: DEVICE_NOT_FOUND")

    real = cl.get_platforms()
    monkeypatch.setattr(cl, "get_platforms", lambda: [Broken(), *real])
    assert [item.id for item in list_devices()] == [
        f"{p + 1}:{d}" for p in range(len(real)) for d in range(len(real[p].get_devices()))
    ]


def test_what_a_device_says_of_itself():
    for item in list_devices():
        platform, index = map(int, item.id.split(":"))
        handle = cl.get_platforms()[platform].get_devices()[index]
        assert (item.name, item.memory) == (handle.name.strip(), handle.global_mem_size)
        assert item.kind in ("gpu", "accelerator", "cpu")
        assert 0 < item.largest_allocation <= item.memory
        assert item.compute_units >= 1
        assert item.unified or item.kind != "cpu"
        with pytest.raises(dataclasses.FrozenInstanceError):
            item.name = "other"


@pytest.mark.parametrize(
    ("kinds", "best"),
    [
        ([("cpu", 64), ("gpu", 8), ("gpu", 16), ("accelerator", 128)], 2),
        ([("cpu", 64), ("accelerator", 4)], 1),
        ([("cpu", 8), ("cpu", 64)], 1),
        ([("gpu", 8), ("gpu", 8)], 0),
    ],
)
def test_auto_prefers_gpus_then_memory(pretend, kinds, best):
    found = [info(f"0:{n}", kind, memory << 30) for n, (kind, memory) in enumerate(kinds)]
    pretend(*found)
    assert choose("auto") is found[best]


def test_auto_passes_over_a_device_that_cannot_be_opened(pretend, monkeypatch, caplog):
    gpu, cpu = info("0:0", "gpu", 8 << 30), info("1:0", "cpu", 8 << 30)
    pretend(gpu, cpu)

    def open_(item, handle):
        if item is gpu:
            raise DeviceError("OpenCL device 'device 0:0' could not be opened")
        return item

    monkeypatch.setattr(devices, "_open", open_)
    assert choose("auto") is cpu
    assert "could not be opened; trying the next device" in caplog.text
    with pytest.raises(DeviceError, match="could not be opened"):
        choose("0:0")


@pytest.mark.parametrize("spec", ["9:9", "gpu", "", "0", "0:0:0", "AUTO", "-1:0"])
def test_a_wrong_spec_lists_the_valid_ones(pretend, spec):
    pretend(info("0:0", "gpu", 1 << 30), info("2:1", "cpu", 1 << 30))
    with pytest.raises(DeviceError) as caught:
        choose(spec)
    assert str(caught.value) == (
        f"there is no OpenCL device '{spec}'; use 'auto', 'none' or one of '0:0' (device 0:0), '2:1' (device 2:1)"
    )


def test_none_does_not_look_for_devices(monkeypatch):
    monkeypatch.setattr(devices, "_physical", lambda: pytest.fail("looked"))
    assert choose("none") is None


def test_one_device_per_process_for_all_threads():
    identity = list_devices()[0].id
    found = []
    threads = [threading.Thread(target=lambda: found.append(choose(identity))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(map(id, found))) == 1
    assert found[0].info.id == identity
    assert found[0].queue.properties & cl.command_queue_properties.PROFILING_ENABLE
    assert not found[0].queue.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE


def test_class_id_names_platform_device_and_driver(shared, copying):
    for part in (shared.info.platform, shared.info.name, shared.info.driver):
        assert part in shared.class_id
    assert copying.class_id == shared.class_id


def test_a_device_that_vanished(monkeypatch, shared):
    monkeypatch.setattr(devices, "_physical", list)
    with pytest.raises(DeviceError, match="is no longer there"):
        type(shared)(shared.info)
