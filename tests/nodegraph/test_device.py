"""Twins in a run: which implementation computes, where values lie, and what happens when the device cannot."""

from __future__ import annotations

import logging

import numpy as np
import pytest

import nodegraph.produce
import nodegraph.run
from nodegraph import Graph, node, port_type
from nodegraph.cache import Cache
from nodegraph.errors import DeviceError, RunError
from nodegraph.opencl import Device, is_on_device, list_devices

RAN: list[str] = []


@port_type
class Plate:
    """A toy raster for twins."""

    data: np.ndarray


@node(version=1)
def plate(*, size: int = 1000) -> Plate:
    """Make numbers."""
    return Plate(np.arange(size, dtype=np.float32))


@node(version=1)
def twice(surface: Plate) -> Plate:
    """Double, on the host or on the device."""
    RAN.append("host twice")
    return Plate(surface.data * 2)


@twice.opencl()
def _(surface: Plate) -> Plate:
    assert is_on_device(surface)
    RAN.append("device twice")
    return Plate(surface.data * np.float32(2))


@node(version=1)
def total(surface: Plate) -> float:
    """Add up, on the host."""
    assert isinstance(surface.data, np.ndarray)
    return float(surface.data.sum())


@node(version=1)
def clumsy(surface: Plate) -> Plate:
    """Works on the host only."""
    return Plate(surface.data + 1)


@clumsy.opencl()
def _(surface: Plate) -> Plate:
    raise DeviceError("wanted 3 GB of device memory, 1 GB is free")


@pytest.fixture(autouse=True)
def _fresh():
    RAN.clear()


@pytest.fixture
def discrete(monkeypatch):
    """Let the run choose a device that shares no memory with the host, as a graphics card does not."""
    device = Device(list_devices()[0], unified=False)
    monkeypatch.setattr(nodegraph.run, "choose", lambda spec: None if spec == "none" else device)
    return device


@pytest.fixture
def transfers(monkeypatch):
    """Count the values that are copied to and from the device."""
    counts = {"up": 0, "down": 0}

    def to_device(value, device, original=nodegraph.produce.to_device):
        counts["up"] += not is_on_device(value)
        return original(value, device)

    def to_host(value, original=nodegraph.produce.to_host):
        counts["down"] += is_on_device(value)
        return original(value)

    monkeypatch.setattr(nodegraph.produce, "to_device", to_device)
    monkeypatch.setattr(nodegraph.produce, "to_host", to_host)
    return counts


def chain(length: int = 3) -> Graph:
    graph = Graph()
    last = graph.add(plate, "plate")
    for number in range(length):
        last = graph.add(twice, f"t{number}", surface=last)
    graph.add(total, "total", surface=last)
    return graph


def test_the_twin_computes_on_a_device_and_the_host_without_one():
    graph, cache = chain(1), Cache(None)
    assert graph.run(cache=cache)["total"] == 999_000
    assert graph.run(cache=cache, device="none")["total"] == 999_000
    assert RAN == ["device twice", "host twice"]


def test_results_of_device_and_host_are_remembered_apart():
    graph, cache = chain(1), Cache(None)
    graph.run(cache=cache)
    result = graph.run(cache=cache, device="none")
    assert result.nodes["plate"].status == "cached"
    assert "device changed" in result.nodes["t0"].reason
    assert graph.run(cache=cache).nodes["t0"].status == "cached"


def test_a_chain_of_twins_stays_on_the_device(discrete, transfers):
    chain(3).run(cache=Cache(None))  # builds the kernel, which takes long enough for the value to be worth storing
    RAN.clear()
    transfers.update(up=0, down=0)
    assert chain(3).run(cache=Cache(None))["total"] == 499_500 * 8
    assert RAN == ["device twice"] * 3
    assert transfers == {"up": 1, "down": 1}


def test_a_value_of_a_discrete_device_is_handed_out_on_the_host(discrete):
    result = chain(2).run(["t1"], cache=Cache(None))
    assert isinstance(result["t1"].data, np.ndarray)
    np.testing.assert_array_equal(result["t1"].data, np.arange(1000) * 4)
    assert isinstance(result["t0"].data, np.ndarray)


def test_values_that_stayed_on_the_device_are_known_the_next_time(discrete, tmp_path):
    graph = chain(3)
    graph.run(cache=Cache(tmp_path))
    RAN.clear()
    again = graph.run(cache=Cache(tmp_path))
    assert {run.status for run in again.nodes.values()} == {"cached"}
    assert RAN == []
    graph.add(total, "other", surface="t1")
    assert graph.run(cache=Cache(tmp_path))["other"] == 499_500 * 4


def test_what_an_automatic_device_cannot_do_the_host_does(caplog):
    graph = Graph()
    graph.add(clumsy, "c", surface=graph.add(plate))
    with caplog.at_level(logging.WARNING, "nodegraph"):
        result = graph.run(cache=Cache(None))
    assert result["c"].data[0] == 1
    assert "without OpenCL: wanted 3 GB" in caplog.text


def test_what_a_chosen_device_cannot_do_fails():
    graph = Graph()
    graph.add(clumsy, "c", surface=graph.add(plate))
    with pytest.raises(RunError, match="wanted 3 GB of device memory"):
        graph.run(cache=Cache(None), device="0:0")


def test_an_absent_device_is_refused_before_anything_runs():
    with pytest.raises(DeviceError, match="9:9"):
        chain(1).run(cache=Cache(None), device="9:9")
    assert RAN == []
