from __future__ import annotations

from pathlib import Path
from threading import Event

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from nodegraph.context import Context
from nodegraph.errors import Cancelled
from nodegraph_terrain import voids
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation, Extent, Mask, ground_cell
from nodegraph_terrain.voids import fill_voids


def surface(data: object, dx: float = 10.0, dy: float = 10.0) -> Elevation:
    array = np.asarray(data, np.float32)
    return Elevation(array, Extent(0, 0, array.shape[1] * dx, array.shape[0] * dy))


def residual(values: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """Return how far every cell is from the weighted mean of its neighbours; the edge mirrors."""
    padded = np.pad(values.astype(np.float64), 1, mode="edge")
    across = (padded[1:-1, 2:] - 2 * padded[1:-1, 1:-1] + padded[1:-1, :-2]) / dx**2
    down = (padded[2:, 1:-1] - 2 * padded[1:-1, 1:-1] + padded[:-2, 1:-1]) / dy**2
    return np.abs(across + down) / (2 / dx**2 + 2 / dy**2)


def test_a_plane_comes_back_exactly() -> None:
    rows, cols = np.mgrid[0:40, 0:50]
    plane = 1000 + 3 * rows - 2.5 * cols
    holed = plane.astype(np.float32)
    holed[5:30, 8:40] = np.nan
    filled = fill_voids(surface(holed, 12.0, 7.0))
    assert isinstance(filled, Elevation)
    np.testing.assert_allclose(filled.data, plane, atol=1e-3)


def test_one_cell_takes_the_weighted_mean_of_its_neighbours() -> None:
    filled = fill_voids(surface([[0, 10, 0], [20, np.nan, 40], [0, 50, 0]], dx=1.0, dy=2.0))
    assert filled.data[1, 1] == pytest.approx(((20 + 40) * 2 + (10 + 50) / 2) / 5)


def test_a_harmonic_function_comes_back_to_discretisation_error() -> None:
    y, x = np.mgrid[-1:1:101j, -1:1:101j]
    harmonic = 500 * np.exp(x) * np.cos(y)
    holed = harmonic.astype(np.float32)
    holed[(x**2 + y**2) < 0.6] = np.nan
    filled = fill_voids(surface(holed, 1.0, 1.0))
    assert np.abs(filled.data - harmonic).max() < 500 * 1e-4


@settings(max_examples=40, deadline=None)
@given(
    arrays(np.float32, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.floats(-400, 8000, width=32)),
    st.integers(0, 2**32),
    st.sampled_from([(10.0, 10.0), (10.0, 4.0)]),
)
def test_filled_cells_are_harmonic_and_within_the_known_range(
    data: np.ndarray, seed: int, cell: tuple[float, float]
) -> None:
    missing = np.random.default_rng(seed).random(data.shape) < 0.6
    missing.flat[seed % missing.size] = False
    holed = np.where(missing, np.float32(np.nan), data)
    before = holed.copy()
    filled = fill_voids(surface(holed, *cell)).data
    np.testing.assert_array_equal(filled[~missing], data[~missing])
    np.testing.assert_array_equal(holed, before)
    # An edge that mirrors is a neighbour equal to the cell itself, which is what padding with edge values gives.
    assert (residual(filled, *cell)[missing] < 2e-3).all()
    assert filled.min() >= data[~missing].min() - 1e-3
    assert filled.max() <= data[~missing].max() + 1e-3


def test_multigrid_agrees_with_a_direct_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    data = rng.normal(1000, 200, (150, 170)).cumsum(0).astype(np.float32) / 50
    data[20:120, 30:140] = np.nan
    data[60:80, 70:100] = 777.0
    by_multigrid = fill_voids(surface(data)).data
    monkeypatch.setattr(voids, "DIRECT", 1 << 30)
    np.testing.assert_allclose(by_multigrid, fill_voids(surface(data)).data, atol=1e-3)


def test_batches_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    data = rng.normal(0, 100, (80, 80)).astype(np.float32)
    data[rng.random(data.shape) < 0.4] = np.nan
    together = fill_voids(surface(data)).data
    monkeypatch.setattr(voids, "BATCH", 50)
    np.testing.assert_allclose(together, fill_voids(surface(data)).data, atol=1e-4)


def test_nearest_is_the_nearest_on_the_ground() -> None:
    holed = surface([[5, np.nan, np.nan], [np.nan, np.nan, 9]], dx=1.0, dy=100.0)
    np.testing.assert_array_equal(fill_voids(holed, method="nearest").data, [[5, 5, 5], [9, 9, 9]])


def test_larger_voids_stay() -> None:
    data = np.ones((6, 9), np.float32)
    data[1, 1], data[3:5, 3:7] = np.nan, np.nan
    for method in ("laplace", "nearest"):
        filled = fill_voids(surface(data), method=method, maximum_size=7).data
        assert filled[1, 1] == 1
        assert np.isnan(filled).sum() == 8
        assert not np.isnan(fill_voids(surface(data), method=method, maximum_size=8).data).any()
    assert fill_voids(surface(data), maximum_size=None).data.sum() == data.size


def test_degrees_count_on_the_ground() -> None:
    data = np.array([[0, 10, 0], [20, np.nan, 40], [0, 50, 0]], np.float32)
    north = Elevation(data, Extent(8, 59.9985, 8.003, 60.0015, "EPSG:4326", "deg"))
    # At 60 degrees a cell is half as wide as high.
    assert fill_voids(north).data[1, 1] == pytest.approx(((20 + 40) * 2 + (10 + 50) / 2) / 5, rel=1e-4)


def test_nothing_to_fill_gives_the_value_itself_and_roles_stay() -> None:
    whole = Mask(np.full((3, 3), 0.5, np.float32), Extent(0, 0, 3, 3))
    assert fill_voids(whole) is whole
    holed = whole.like(np.where(np.eye(3, dtype=bool), np.float32(np.nan), whole.data))
    assert type(fill_voids(holed)) is Mask


def test_an_all_void_raster_is_refused() -> None:
    with pytest.raises(ValueError, match="all void"):
        fill_voids(surface(np.full((4, 4), np.nan)))


def test_a_cancelled_run_stops() -> None:
    cancelled = Event()
    cancelled.set()
    with pytest.raises(Cancelled):
        fill_voids(surface([[1, np.nan]]), context=Context("fill", cancelled=cancelled))


@pytest.mark.parametrize("name", ["alps_N46E008/N46E008.tif", "everest"])
def test_real_srtm_voids(real_data: Path, name: str) -> None:
    path = real_data / name
    dem = load_elevation(path=tuple(sorted(path.glob("*.hgt"))) if path.is_dir() else path)
    missing = np.isnan(dem.data)
    filled = fill_voids(dem)
    np.testing.assert_array_equal(filled.data[~missing], dem.data[~missing])
    assert filled.data.min() >= np.nanmin(dem.data)
    assert filled.data.max() <= np.nanmax(dem.data)
    # Rounding to float32 at 8000 m leaves up to half a millimetre per neighbour.
    assert residual(filled.data, *ground_cell(dem))[missing].max() < 2e-3


def everest(folder: Path) -> Elevation:
    return load_elevation(path=tuple(sorted((folder / "everest").glob("*.hgt"))))


@pytest.mark.slow
def test_the_voids_of_everest(real_data: Path) -> None:
    """Four tiles as one: every void takes heights between the lowest and the highest of the cells beside it."""
    tiles = [load_elevation(path=path) for path in sorted((real_data / "everest").glob("*.hgt"))]
    assert sum(int(np.isnan(tile.data).sum()) for tile in tiles) == 305_338
    dem = everest(real_data)
    assert dem.shape == (2401, 2401)
    missing = np.isnan(dem.data)
    # Of what two tiles share, voids of the one are known in the other, or count once.
    assert 304_000 < missing.sum() < 305_338
    filled = fill_voids(dem).data
    np.testing.assert_array_equal(filled[~missing], dem.data[~missing])
    assert np.isfinite(filled).all()
    labels, count = ndimage.label(missing)
    assert count > 1000
    low, high = np.full(count + 1, np.inf), np.full(count + 1, -np.inf)
    for axis in (0, 1):
        for step in (1, -1):
            # The cell beside, where there is one; the edge of the raster has none.
            index = np.clip(np.arange(2401) + step, 0, 2400)
            beside = np.take(dem.data, index, axis=axis)
            rim = missing & ~np.isnan(beside)
            np.minimum.at(low, labels[rim], beside[rim])
            np.maximum.at(high, labels[rim], beside[rim])
    assert (filled[missing] >= low[labels[missing]]).all()
    assert (filled[missing] <= high[labels[missing]]).all()


@pytest.mark.slow
def test_voids_cut_into_known_ground_come_back_as_well_as_by_gdal(real_data: Path) -> None:
    """The voids of Everest cut into the Andes: the membrane beside GDAL's weighted means, and the nearest cell."""
    from rasterio.fill import fillnodata

    andes = load_elevation(path=real_data / "andes_S33W071" / "S33W071.tif")
    voids_of = np.isnan(everest(real_data).data)
    for row, col in ((0, 0), (1200, 0), (0, 1200), (1200, 1200)):
        missing = voids_of[row : row + 1201, col : col + 1201]
        holed = andes.like(np.where(missing, np.float32(np.nan), andes.data))

        def error(filled: np.ndarray, missing: np.ndarray = missing) -> float:
            return float(np.sqrt(np.mean((filled - andes.data)[missing].astype(np.float64) ** 2)))

        # Its default smooths nothing; a distance that reaches across every void.
        known = np.where(missing, np.float32(0), andes.data)
        by_gdal = error(fillnodata(known, mask=(~missing).astype(np.uint8), max_search_distance=400))
        membrane, nearest = error(fill_voids(holed).data), error(fill_voids(holed, method="nearest").data)
        assert membrane < 1.1 * by_gdal
        assert membrane < 0.9 * nearest
