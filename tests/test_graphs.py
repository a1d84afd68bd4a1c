"""Every example graph: valid, saved as it stands, and run end to end, twice."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nodegraph import Graph
from nodegraph.cache import Cache

FILES = sorted((Path(__file__).parents[1] / "graphs").rglob("*.json"))
GRAPHS = [path for path in FILES if "inputs" not in json.loads(path.read_text())]
"""Those that run by themselves; the others are parts of them, waiting for what is linked to them."""


@pytest.fixture(params=GRAPHS, ids=lambda path: path.stem)
def path(request) -> Path:
    return request.param


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_it_saves_as_it_stands(file, tmp_path):
    graph = Graph.load(file)
    assert graph.save(tmp_path / file.name).read_bytes() == file.read_bytes()
    assert graph.title


def test_it_is_valid(path):
    Graph.load(path).validate()


def test_every_part_is_used():
    parts = {path for path in FILES if path not in GRAPHS}
    used = {
        (file.parent / record["params"]["path"]).resolve()
        for file in FILES
        for record in Graph.load(file).nodes.values()
        if record["type"] == "graph"
    }
    assert parts <= used


def test_it_runs_and_then_answers_from_the_cache(path, tmp_path):
    graph = Graph.load(path)
    # Coarser than the picture in the gallery: it is the graph that is tested here.
    sample = graph.nodes.get("sample", {}).get("params", {})
    coarse = {"sample.cell_size": 4 * sample["cell_size"]} if "cell_size" in sample else {}
    crops = any(record["type"] == "terrain.crop" for record in graph.nodes.values())  # by cells
    for name, record in graph.nodes.items():
        if record["type"] in ("render.picture", "render.sphere_trace"):
            coarse |= {f"{name}.width": 160, f"{name}.height": 90}
        elif record["type"] == "terrain.reproject" and not crops:
            coarse |= {f"{name}.cell_size": 2 * record["params"]["cell_size"]}
        elif record["type"] == "hydrology.rasterize_features":
            coarse |= {f"{name}.cell_size": 40}
        elif record["type"] == "texture.save_tiles":
            coarse |= {f"{name}.levels": [9, 10]}
        elif record["type"] == "render.flight":
            coarse |= {f"{name}.width": 64, f"{name}.height": 36, f"{name}.frame_rate": 0.5}
    cache = Cache(tmp_path / "cache")
    result = graph.run(set=coarse, cache=cache, out=tmp_path / "out")
    assert result.files_written
    for file in result.files_written:
        if file.suffix == ".png":
            picture = np.asarray(Image.open(file).convert("L"), np.float64)
            assert picture.std() > 5, f"{file.name} is blank"
    again = graph.run(set=coarse, cache=cache, out=tmp_path / "out")
    assert {run.status for run in again.nodes.values()} == {"cached"}
    assert again.files_written == []
    cache.close()
