"""Formats of another plugin: what terrain.load_elevation and save_elevation make of them."""

from __future__ import annotations

import importlib
import itertools
import os
import sys
import textwrap
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodegraph import Forecast, Graph, GraphError
from nodegraph.cache import Cache
from nodegraph.errors import sentence
from nodegraph.plan import fingerprints
from nodegraph.plugins import GROUP, registry
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.formats.table import FORMATS
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation, Extent, Image, Mask, Raster
from nodegraph_terrain.save import save_elevation, save_image
from tests.nodegraph import support as toy

_numbers = itertools.count()

SONG = """
    '''Songs: a line of text for each row of heights; the place is five numbers in the last line.'''

    from contextlib import contextmanager

    import numpy as np
    from nodegraph import File, Format, hookimpl
    from nodegraph_terrain.formats.contents import Contents
    from nodegraph_terrain.raster import Elevation, Extent, Image, Raster

    CALLS = []

    def read(path):
        '''Read all at once.'''
        CALLS.append(path.name)
        *lines, place = path.read_text().splitlines()
        rows = np.array([[float(item) for item in line.split()] for line in lines], np.float32)
        return Elevation(rows, Extent(*map(float, place.split())))

    def write(surface, name):
        e = surface.extent
        lines = [" ".join(map(repr, row)) for row in [*surface.data.tolist(), [e.west, e.south, e.east, e.north]]]
        return File.of(name, "\\n".join(lines).encode())

    @contextmanager
    def open_bytes(path, *, band=1):
        '''Open one byte for each cell, 3 x 4 of them a band.'''
        cells = np.memmap(path, "u1", "r").reshape(-1, 3, 4)[band - 1]
        yield Contents(3, 4, cells.dtype, lambda rows: cells[rows], Extent(0, 0, 4, 3), "ft", scale=2.0, offset=1.0)

    def write_bytes(surface, name, *, minimum=None, maximum=None):
        return File.of(name, f"{minimum} {maximum}".encode())

    def read_twice(path):
        '''Take .npy over.'''
        return Elevation(2 * np.load(path), Extent(0, 0, 10, 10))

    def read_wrongly(path):
        return np.zeros((2, 2))

    @contextmanager
    def open_wrongly(path):
        yield Contents(3, 4, np.dtype("f4"), lambda rows: np.zeros((3, 5)), Extent(0, 0, 4, 3))

    def write_picture(image, name):
        return File.of(name, image.data.tobytes())

    @hookimpl
    def nodegraph_formats():
        return [
            Format(Raster, (".song",), "Song", read=read, write=write),
            Format(Elevation, (".byt",), "Bytes", open=open_bytes, write=write_bytes),
            Format(Elevation, (".npy",), "Double", read=read_twice),
            Format(Elevation, (".wrong",), "Wrong", read=read_wrongly),
            Format(Elevation, (".odd",), "Odd", open=open_wrongly),
            Format(Image, (".dots",), "Dots", write=write_picture),
        ]
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Have a plugin with formats installed beside the project's own, and return its module."""
    name = f"toy_songs_{os.getpid()}_{next(_numbers)}"
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / f"{name}.py").write_text(textwrap.dedent(SONG))
    monkeypatch.syspath_prepend(folder)
    points = [*entry_points(group=GROUP), EntryPoint(name, name, GROUP)]
    monkeypatch.setattr("nodegraph.plugins.entry_points", lambda group: points)
    registry.cache_clear()
    fingerprints.cache_clear()
    yield importlib.import_module(name)
    sys.modules.pop(name)
    registry.cache_clear()
    fingerprints.cache_clear()


def song(path: Path, west: float = 0.0, rows: str = "1 2 3\n4 5 -1") -> Path:
    path.write_text(f"{rows}\n{west} 0 {west + 30} 20")
    return path


def forecast(*paths: Path) -> Forecast:
    params = load_elevation.parameters.check({"path": [str(path) for path in paths]}).values
    return load_elevation.predict({}, params)


def write(file: Any, folder: Path) -> Path:
    path: Path = folder / file.name
    path.write_bytes(file.content.tobytes())
    return path


def test_every_format_has_a_reader_or_a_writer_of_its_module() -> None:
    for item in FORMATS:
        for function in (*item.functions("read"), *item.functions("write")):
            assert function.__module__.startswith("nodegraph_terrain.formats."), item
            assert function.__doc__, item


def test_a_format_that_reads_at_once(plugin: Any, tmp_path: Path) -> None:
    dem = load_elevation(path=song(tmp_path / "a.song"))
    np.testing.assert_array_equal(dem.data, [[1, 2, 3], [4, 5, -1]])
    assert (dem.extent.west, dem.extent.north, dem.cell_size) == (0.0, 20.0, (10.0, 10.0))
    assert plugin.CALLS == ["a.song"], "read once, not once for the outline and once for the heights"


def test_what_is_stated_holds_for_every_format(plugin: Any, tmp_path: Path) -> None:
    path = song(tmp_path / "a.song")
    dem = load_elevation(path=path, nodata=-1.0, vertical_unit="ft", extent=(8, 46, 8.3, 46.2), crs="EPSG:4326")
    np.testing.assert_allclose(dem.data, np.array([[1, 2, 3], [4, 5, np.nan]]) * 0.3048, rtol=1e-6)
    assert (dem.extent.west, dem.extent.crs, dem.extent.unit) == (8.0, "EPSG:4326", "deg")
    with pytest.raises(ValueError, match="apply to unsigned integers only"):
        load_elevation(path=path, minimum=0.0, maximum=1.0)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"'a.song' is empty; expected a raster of heights"):
        load_elevation(path=path)


def test_a_format_that_is_opened_gets_the_parameters_it_names(plugin: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.byt"
    cells = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    path.write_bytes(cells.tobytes())
    np.testing.assert_allclose(load_elevation(path=path).data, (cells[0] * 2.0 + 1) * 0.3048, rtol=1e-6)
    dem = load_elevation(path=path, band=2, vertical_unit="m", minimum=0.0, maximum=255.0)
    np.testing.assert_allclose(dem.data, cells[1], rtol=1e-6)
    assert dem.cell_size == (1.0, 1.0)


def test_tiles_of_several_formats_make_one_raster(plugin: Any, tmp_path: Path) -> None:
    east = write(
        save_elevation(Elevation(np.full((2, 3), 9, np.float32), Extent(30, 0, 60, 20)), name="e.tif"), tmp_path
    )
    west, far = song(tmp_path / "w.song"), song(tmp_path / "f.song", 60.0)
    dem = load_elevation(path=(west, east, far))
    np.testing.assert_array_equal(dem.data, [[1, 2, 3, 9, 9, 9, 1, 2, 3], [4, 5, -1, 9, 9, 9, 4, 5, -1]])
    assert sorted(plugin.CALLS) == ["f.song", "w.song"]


def test_a_forecast_opens_what_has_a_head_and_leaves_the_rest_alone(plugin: Any, tmp_path: Path) -> None:
    (tmp_path / "a.byt").write_bytes(bytes(12))
    known = outline(forecast(tmp_path / "a.byt"))
    assert known is not None
    assert (known.rows, known.cols, forecast(tmp_path / "a.byt").bytes) == (3, 4, 48)
    unknown = forecast(song(tmp_path / "a.song"))
    assert outline(unknown) is None
    assert not unknown.known
    assert not forecast(tmp_path / "a.byt", tmp_path / "a.song").known
    assert plugin.CALLS == []


def test_a_role_may_be_taken_over_and_the_others_stay(plugin: Any, tmp_path: Path) -> None:
    dem = Elevation(np.array([[1, 2]], np.float32), Extent(0, 0, 2, 1))
    path = write(save_elevation(dem, name="a.npy"), tmp_path)
    np.testing.assert_array_equal(load_elevation(path=path).data, [[2, 4]])
    formats = registry().formats()
    assert formats.find(Mask, "a.npy", "read").title == "NumPy array"
    assert formats.find(Elevation, "a.npy", "write").title == "NumPy array"


def test_a_format_writes_what_it_reads(plugin: Any, tmp_path: Path) -> None:
    dem = Elevation(np.random.default_rng(3).normal(500, 90, (7, 5)).astype(np.float32), Extent(10, 20, 60, 90))
    again = load_elevation(path=write(save_elevation(dem, name="a.song"), tmp_path))
    np.testing.assert_array_equal(again.data, dem.data)
    assert again.cell_size == dem.cell_size
    image = Image(np.zeros((2, 2, 3), np.uint8), Extent(0, 0, 2, 2))
    assert save_image(image, name="a.dots").content.tolist() == [0] * 12


def test_what_a_writer_does_not_take_is_refused(plugin: Any) -> None:
    dem = Elevation(np.zeros((2, 2), np.float32), Extent(0, 0, 2, 2))
    with pytest.raises(ValueError) as caught:
        save_elevation(dem, name="a.song", minimum=3.0)
    assert str(caught.value) == (
        "'a.song' keeps heights as they are; minimum and maximum are for .png and .r16 and .byt only"
    )
    assert save_elevation(dem, name="a.byt", minimum=3.0).content.tobytes() == b"3.0 None"
    with pytest.raises(ValueError, match=r"choose one of .tif, .png, .r16, .r32, .asc, .npy, .h5, .song$"):
        save_elevation(Raster(dem.data, dem.extent), name="a.byt")
    image = Image(np.zeros((2, 2, 3), np.uint8), Extent(0, 0, 2, 2))
    with pytest.raises(ValueError, match=r"'a.dots' takes no world file; world_file is for .png and .tif only"):
        save_image(image, name="a.dots", world_file=True)
    with pytest.raises(ValueError, match=r"'a.gif' ends in '.gif'; choose one of .png, .tif, .dots"):
        save_image(image, name="a.gif")


def test_what_is_no_raster_names_every_format(plugin: Any, tmp_path: Path) -> None:
    (tmp_path / "a.foo").write_text("hello")
    with pytest.raises(ValueError, match=r"expected GeoTIFF, .*\.npy, .*\.song, .* or another format of GDAL"):
        load_elevation(path=tmp_path / "a.foo")


def test_a_reader_that_gives_something_else_is_named(plugin: Any, tmp_path: Path) -> None:
    for name, message in (
        ("a.wrong", "TypeError: the reader of Wrong gave 'a.wrong' as ndarray, not as Raster"),
        ("a.odd", "'a.odd' gave (3, 5) cells for rows 0 to 3 of 4 columns"),
    ):
        (tmp_path / name).write_text("x")
        with pytest.raises((TypeError, ValueError)) as caught:
            load_elevation(path=tmp_path / name)
        assert sentence(caught.value) == message


def test_the_example_of_the_readme_works(tmp_path: Path) -> None:
    text = Path(__file__).parents[2].joinpath("README.md").read_text()
    (source,) = [block for block in text.split("```python\n") if "nodegraph_formats" in block]
    scope: dict[str, Any] = {"__name__": "acme_heights"}
    exec(source.partition("```")[0], scope)
    (form,) = scope["nodegraph_formats"]()
    dem = Elevation(np.array([[1.5, 2], [3, 4], [5, 6]], np.float32), Extent(0, 0, 20, 30))
    again = form.functions("read")[0](write(form.functions("write")[0](dem, "a.heights"), tmp_path))
    np.testing.assert_array_equal(again.data, dem.data)
    assert again.cell_size == dem.cell_size


def test_in_a_graph(plugin: Any, tmp_path: Path) -> None:
    def graph(out: str) -> Graph:
        made = Graph("Songs")
        made.add("terrain.load_elevation", "in", path=str(song(tmp_path / "a.song")))
        made.add("terrain.save_elevation", "out", surface="in", name=out)
        return made

    cache = Cache(None)
    for status in ("computed", "cached"):
        result = graph("b.song").run(cache=cache, out=tmp_path)
        assert {run.status for run in result.nodes.values()} == {status}
    np.testing.assert_array_equal(load_elevation(path=tmp_path / "b.song").data, result["in"].data)
    with pytest.raises(GraphError, match=r"node 'out': parameter 'name': 'b.sing' ends in '.sing'; choose one of .tif"):
        graph("b.sing").validate()
    covered = {path.name for path in fingerprints().files(load_elevation, (plugin.read,))}
    assert f"{plugin.__name__}.py" in covered
    assert not covered & {"arrays.py", "gdal_raster.py", "table.py"}, "only the code that reads this file"


def test_the_code_of_a_reader_is_the_same_in_every_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Openers are wrapped by the standard library: what they close over counts, by its content."""
    code = """
        import sys
        from nodegraph.plan import fingerprints
        from nodegraph_terrain.load import load_elevation
        from nodegraph_terrain.formats.table import FORMATS
        for item in FORMATS:
            for use in ("read", "write"):
                if item.functions(use):
                    print(item.title, fingerprints().of(load_elevation, item.functions(use)).hex())
    """
    found = set()
    for seed in ("1", "2"):
        monkeypatch.setenv("PYTHONHASHSEED", seed)
        found.add(toy.python(code))
    (text,) = found
    assert len(text.splitlines()) > len(FORMATS)
