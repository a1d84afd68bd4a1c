"""The terrain of graphs/hydrology/terrain_from_rivers.json obeys the rivers that it was designed from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nodegraph import Graph
from nodegraph_hydrology.compare_networks import compare_networks

GRAPHS = Path(__file__).parents[2] / "graphs" / "hydrology"
TARGETS = ("terrain", "heights", "check.followed", "check.found", "check.agreement")


def run(name="terrain_from_rivers", **params):
    return Graph.load(GRAPHS / f"{name}.json").run(TARGETS, set=params)


@pytest.fixture(scope="module")
def quarter():
    """256 x 256 cells of the size of the whole: a quarter of its sides, its lines as much smaller."""
    side = 2500
    record = json.loads((GRAPHS / "terrain_from_rivers.json").read_text(encoding="utf-8"))
    lines = record["parameters"]["lines"]["default"]
    small = [[[x / 4, y / 4] for x, y in line] for line in lines]
    ring = [[0, 0], [side, 0], [side, side], [0, side], [0, 0]]
    extent = {"outline.points": ring, "skeleton.extent": [0, 0, side, side]}
    return run(**extent, lines=small, depth=2, relief=250, seed=1)


def test_streams_follow_the_design_and_find_it(quarter):
    assert quarter["terrain"].shape == (256, 256)
    assert quarter["check.followed"] >= 0.9
    assert quarter["check.found"] >= 0.9
    assert quarter["check.agreement"].designed_cells > 1000


def test_other_rivers_are_not_obeyed(quarter):
    """The measure tells: the same rivers mirrored are neither followed nor found."""
    rivers = quarter["heights"]
    mirrored = replace(rivers, position=np.array([2500, 0]) + rivers.position * [-1, 1])
    other = compare_networks(mirrored, quarter["terrain"], threshold=quarter["check.agreement"].threshold)
    assert other.followed < 0.7
    assert other.found < 0.7


def slopes(terrain):
    """Return the slope between each cell and the next ones east and south."""
    z = terrain.data / terrain.cell_size[0]
    return np.hypot(np.diff(z, axis=1)[:-1], np.diff(z, axis=0)[:, :-1])


def test_no_cliff_parts_neighbouring_basins(quarter):
    assert np.quantile(slopes(quarter["terrain"]), 0.999) < 2


@pytest.mark.slow
@pytest.mark.parametrize("depth", [4, 5])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_whole_obeys_its_rivers(seed, depth):
    result = run(seed=seed, depth=depth)
    assert result["terrain"].shape == (1024, 1024)
    assert result["check.followed"] >= 0.9
    assert result["check.found"] >= 0.9


@pytest.mark.slow
def test_it_obeys_more_than_the_pipeline_as_printed():
    ours, printed = run(seed=3), run("terrain_as_printed", seed=3)
    assert ours["check.followed"] > printed["check.followed"]
    assert ours["check.found"] > printed["check.found"]


@pytest.mark.slow
def test_cliffs_are_what_the_greatest_slope_across_divides_takes_away():
    kept, free = (slopes(run(seed=3, **more)["terrain"]) for more in ({}, {"heights.steepest": None}))
    assert np.quantile(kept, 0.999) < 2 < 5 < np.quantile(free, 0.999)
