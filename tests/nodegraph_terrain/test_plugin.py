from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np

import nodegraph_terrain
from nodegraph.plugins import Registry
from nodegraph_terrain import plugin
from nodegraph_terrain.conversions import mask_image, shade_image
from nodegraph_terrain.raster import GRIDS, Extent, Image, Mask, Shade

HEAVY = ("rasterio", "scipy", "matplotlib", "h5py", "PIL", "pyopencl")
FOLDER = Path(nodegraph_terrain.__path__[0])
MODULES = sorted(
    ".".join(path.relative_to(FOLDER).with_suffix("").parts) for path in FOLDER.rglob("*.py") if path.stem != "__init__"
)


def test_the_registry_takes_the_plugin() -> None:
    found = Registry()
    found.add(plugin)
    for name in ("sample_dem", "load_elevation", "fill_voids", "reproject", "resample", "crop", "save_elevation"):
        node = found.find(f"terrain.{name}")
        assert node is not None, name
        assert node.summary
        assert all(field.param.description for field in node.parameters.fields.values()), name
    for role in GRIDS[1:]:
        assert found.preview(role) is not None
    assert found.conversion(Shade, Image) is not None
    assert found.conversion(Mask, Image) is not None


def test_every_module_with_nodes_belongs_to_the_family() -> None:
    from nodegraph import Node

    for name in MODULES:
        module = importlib.import_module(f"nodegraph_terrain.{name}")
        declares = any(isinstance(item, Node) and item.__module__ == module.__name__ for item in vars(module).values())
        assert declares == (name in plugin.NODE_MODULES), name


def test_importing_any_module_loads_nothing_heavy() -> None:
    imports = [f"import nodegraph_terrain.{name}" for name in MODULES]
    code = "; ".join(["import sys", *imports, f"print([name for name in {HEAVY} if name in sys.modules])"])
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_shades_and_masks_become_grey_pictures() -> None:
    extent = Extent(0, 0, 3, 1)
    shade = shade_image(Shade(np.array([[0, 0.5, 1]], np.float32), extent))
    assert shade.data.tolist() == [[[0, 0, 0], [128, 128, 128], [255, 255, 255]]]
    mask = mask_image(Mask(np.array([[0, np.nan, 1]], np.float32), extent))
    assert mask.data[0, :, 3].tolist() == [255, 0, 255]
    assert mask.extent is extent
