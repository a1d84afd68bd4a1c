"""Measured mountains in a generated valley: the graph of the gallery, with its own tile and with one of the Alps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, laplace

from nodegraph import Graph

GRAPH = Path(__file__).parents[2] / "graphs" / "hydrology" / "blend_mountains.json"
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
ALPS = {"rows": [820, 1260], "columns": [700, 1120], "foot": 2150, "relief": 0.7, "position": [22400, 15000]}
CELL = 40


@pytest.fixture(scope="module", params=["jacksboro", "alps"])
def blend(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Run the graph; return base and result, the piece in its place, where that is, and the width of the feather."""
    document = json.loads(GRAPH.read_bytes())
    values = {name: entry["default"] for name, entry in document["parameters"].items()}
    if request.param == "alps":
        path = DATA / "alps_N46E008" / "N46E008.tif"
        if not path.exists():
            pytest.skip(f"real elevation data is not at {DATA}")
        document["nodes"]["tile"] = {"type": "terrain.load_elevation", "params": {"path": str(path)}}
        values |= ALPS
    result = Graph.from_json(json.dumps(document)).run(
        ["sample.surface", "piece", "massif", "terrain"], set=values, out=tmp_path_factory.mktemp("out")
    )
    base, piece = result["sample"], result["piece"]
    assert base.cell_size == piece.cell_size == (CELL, CELL)
    assert not np.isnan(piece.data).any()
    rows, cols = piece.shape
    east, north = values["position"]
    top = round((base.extent.north - north) / CELL - rows / 2)
    left = round(east / CELL - cols / 2)
    placed, region = np.zeros(base.shape), np.zeros(base.shape, bool)
    placed[top : top + rows, left : left + cols] = values["relief"] * piece.data.astype(np.float64)
    region[top + 1 : top + rows - 1, left + 1 : left + cols - 1] = result["massif"].data[1:-1, 1:-1] >= 0.5
    return {
        "base": base.data.astype(np.float64),
        "made": result["terrain"].data.astype(np.float64),
        "placed": placed,
        "region": region,
        "feather": values["feather"],
    }


def steps(data: np.ndarray, region: np.ndarray, *, seam: bool) -> np.ndarray:
    """Return the steps between cells next to each other: across the edge of the region, or within it."""
    found = []
    for values, mark in ((data, region), (data.T, region.T)):
        wanted = mark[:-1] ^ mark[1:] if seam else mark[:-1] & mark[1:]
        found.append(np.abs(np.diff(values, axis=0))[wanted])
    return np.concatenate(found)


@pytest.mark.slow
def test_outside_nothing_changes(blend: dict[str, Any]) -> None:
    np.testing.assert_array_equal(blend["made"][~blend["region"]], blend["base"][~blend["region"]])
    assert (blend["made"] != blend["base"])[blend["region"]].mean() > 0.99


@pytest.mark.slow
def test_inside_are_the_slopes_of_the_source(blend: dict[str, Any]) -> None:
    made, placed = blend["made"], blend["placed"]
    depth = CELL * distance_transform_edt(blend["region"])
    # The transition ends in a cell at most, and a cell's Laplacian and gradient know of those beside it.
    deep = depth > blend["feather"] + 3 * CELL
    assert deep.sum() > 40_000
    # All that float32 leaves at these heights.
    assert np.abs(laplace(made) - laplace(placed))[deep].max() < 2e-3
    gradient, source = (np.stack(np.gradient(data))[:, deep] for data in (made, placed))
    # The rest is the slope of the harmonic field that brings the piece to the height of the valley.
    assert np.corrcoef(gradient.ravel(), source.ravel())[0, 1] > 0.98
    assert np.sqrt(((gradient - source) ** 2).mean()) < 0.2 * np.sqrt((source**2).mean())


@pytest.mark.slow
def test_the_seam_is_no_steeper_than_the_inside(blend: dict[str, Any]) -> None:
    """At the median, at 90 and 99 %, and at the most; and no more than 1.25 times as steep as the valley was there."""
    made, base, placed, region = (blend[name] for name in ("made", "base", "placed", "region"))
    shares = [50, 90, 99, 100]
    seam, inside = (np.percentile(steps(made, region, seam=at), shares) for at in (True, False))
    assert (seam <= inside).all()
    before = np.percentile(steps(base, region, seam=True), shares[:3])
    assert (seam[:3] <= 1.25 * before).all()
    pasted = np.where(region, placed - (placed - base)[region].mean(), base)
    assert np.median(steps(pasted, region, seam=True)) > 20 * seam[0]
