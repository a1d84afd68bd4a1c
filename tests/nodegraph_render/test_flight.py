"""Pictures in bands, flights that go on where they stopped, and films as files."""

from __future__ import annotations

import io
import itertools

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image as Pillow

from nodegraph import Context
from nodegraph.cache import Cache
from nodegraph.cache.index import Record
from nodegraph.opencl import choose
from nodegraph_render import flight as module
from nodegraph_render import picture as pictures
from nodegraph_render.camera import camera
from nodegraph_render.flight import Film, flight
from nodegraph_render.material import Ground
from nodegraph_render.path import KeyFrame, path
from nodegraph_render.picture import Style, picture, render_picture
from nodegraph_render.save_film import save_film
from nodegraph_render.shade import shade
from nodegraph_render.sun import Sun
from nodegraph_render.surface import Surface
from nodegraph_render.trace import sphere_trace
from nodegraph_render.tracers import Settings
from nodegraph_render.turntable import turntable
from nodegraph_terrain.raster import Elevation, Extent, Image

Y, X = np.mgrid[0:40, 0:60].astype(np.float32)
HILLS = Elevation(400 + 60 * np.sin(X / 5) * np.cos(Y / 4), Extent(0.0, 0.0, 1200.0, 800.0, "EPSG:32632"))
SURFACE = Surface(None, HILLS, Ground(snow_line=430, tree_line=390))
VIEW = camera(HILLS, pitch=20.0)
TABLE = turntable(HILLS, duration=1.0)


def test_a_picture_is_a_trace_that_is_shaded():
    one = picture(VIEW, Sun(120, 30), SURFACE, width=48, height=27, sky_rays=2)
    two = shade(sphere_trace(VIEW, SURFACE, width=48, height=27, supersampling=2), Sun(120, 30), sky_rays=2)
    assert np.array_equal(one.data, two.data)
    assert one.extent == two.extent or (one.extent.width, one.extent.height) == (two.extent.width, two.extent.height)


@pytest.mark.parametrize("on_device", [False, True])
@pytest.mark.parametrize("flat", [False, True])
def test_bands_make_the_same_picture_without_seams(monkeypatch, on_device, flat):
    view = camera(HILLS, pitch=35.0, orthographic=flat)
    device = choose("auto") if on_device else None
    sizes = (66, 90) if on_device else (42, 32)

    def made() -> Image:
        style = Style(metering="sun", sky_rays=4)
        return render_picture(view, Sun(140, 25), (SURFACE,), sizes, 2, Settings(), style, Context(device=device))

    whole = made()
    monkeypatch.setattr(pictures, "BAND", 8 * sizes[1] * 4)
    bands = made()
    apart = np.abs(whole.data.astype(int) - bands.data)
    assert apart.mean() < 0.5
    # The rows beside a seam differ no more than others: by the rounding of a ray at an edge.
    assert (apart > 8).mean() < 2e-3


def test_a_band_of_a_large_picture_takes_little_memory():
    from nodegraph import Forecast

    item = Forecast(0)
    found = picture.predict(
        {"camera": [item], "sun": [], "surfaces": [item]}, {**DEFAULTS, "width": 40_000, "height": 25_000}
    )
    assert found.bytes == 3_000_000_000
    assert found.peak < 1 << 30


DEFAULTS = {name: item.default for name, item in picture.parameters.fields.items()}


def test_pictures_of_nothing_and_from_below_are_refused():
    with pytest.raises(ValueError, match="nothing to look at"):
        picture(VIEW, None, width=2, height=2)
    with pytest.raises(ValueError, match="under the ground"):
        picture(camera(eye=(600, 400, 0), target=(600, 500, 0)), None, SURFACE, width=2, height=2)


# Flights.


def small(**params):
    return {"width": 16, "height": 10, "frame_rate": 6.0, "supersampling": 1, "sky_rays": 0, **params}


def test_frames_are_pictures_along_the_path():
    film = flight(TABLE, Sun(120, 30), SURFACE, **small())
    assert len(film.frames) == 6  # the seventh is the first again
    assert film.closed
    for number in (0, 4):
        alone = picture(
            TABLE.camera(number / 6),
            Sun(120, 30),
            SURFACE,
            width=16,
            height=10,
            supersampling=1,
            sky_rays=0,
            metering="sun",
        )
        assert np.array_equal(film.frames[number].data, alone.data)
    faster = flight(TABLE, Sun(120, 30), SURFACE, **small(duration=0.5))
    assert len(faster.frames) == 3
    assert np.array_equal(faster.frames[1].data, film.frames[2].data)


def test_an_open_path_has_its_last_frame():
    course = path(keys=[KeyFrame(0, (600, -900, 900), (600, 400, 400)), KeyFrame(1, (700, -800, 800), (600, 400, 400))])
    film = flight(course, None, SURFACE, **small(frame_rate=2.0))
    assert len(film.frames) == 3
    assert not film.closed


@pytest.fixture
def rendered(monkeypatch):
    """Count the frames that are rendered, and fail at chosen ones."""
    calls: list[int] = []
    failing: set[int] = set()
    count = itertools.count()

    def render(*args, **kwargs):
        number = next(count)
        if number in failing:
            raise RuntimeError("injected")
        calls.append(number)
        return render_picture(*args, **kwargs)

    monkeypatch.setattr(module, "render_picture", render)
    return calls, failing


def graph_of(tmp_path, **params):
    import json

    from nodegraph.graph import Graph

    nodes = {
        "dem": {"type": "terrain.sample_dem"},
        "metric": {"type": "terrain.reproject", "inputs": {"surface": "dem"}, "params": {"cell_size": 1500}},
        "table": {"type": "render.turntable", "inputs": {"ground": "metric"}, "params": {"duration": 1}},
        "film": {
            "type": "render.flight",
            "inputs": {"path": "table", "surfaces": ["metric"]},
            "params": small(**params),
        },
    }
    file = tmp_path / "flight.json"
    file.write_text(json.dumps({"format": "nodegraph/1", "title": "A flight", "nodes": nodes}))
    return Graph.load(file)


def test_a_flight_goes_on_with_the_first_frame_that_is_missing(tmp_path, monkeypatch, rendered):
    calls, failing = rendered
    # On the smallest pictures loading takes as long as rendering: what counts here is which are kept.
    monkeypatch.setattr(Record, "worth_storing", property(lambda self: True))
    failing.add(3)

    def run(**params):
        # A cache of its own each time, as another process would have: only the folder is shared.
        cache = Cache(tmp_path / "cache")
        try:
            return graph_of(tmp_path, **params).run(["film"], cache=cache, check=False, out=tmp_path / "out")["film"]
        finally:
            cache.close()

    from nodegraph.errors import NodeError

    with pytest.raises(NodeError, match="injected"):
        run()
    assert len(calls) == 3
    film = run()
    assert len(calls) == 6
    assert len(film.frames) == 6
    # What another flight has in common with it is not rendered again.
    again = run(duration=0.5)
    assert len(calls) == 6
    assert np.array_equal(again.frames[2].data, film.frames[4].data)
    # What differs is.
    other = run(exposure=1.0)
    assert len(calls) == 12
    assert not np.array_equal(other.frames[0].data, film.frames[0].data)


def test_a_path_under_the_ground_is_refused_before_the_first_frame(rendered):
    calls, _ = rendered
    course = path(keys=[KeyFrame(0, (600, -900, 900), (600, 400, 400)), KeyFrame(4, (600, 400, 100), (600, 800, 400))])
    with pytest.raises(ValueError, match=r"at 2\.83\d* s of the path the camera is .* m under the ground"):
        flight(course, None, SURFACE, **small())
    assert calls == []


def test_flights_of_a_lifetime_are_refused():
    with pytest.raises(ValueError, match="frames, over 100,000"):
        flight(TABLE, None, SURFACE, **small(duration=90_000.0, frame_rate=24.0))


def test_the_forecast_counts_the_frames():
    made = turntable.predict({"ground": []}, {name: item.default for name, item in turntable.parameters.fields.items()})
    params = {**{name: item.default for name, item in flight.parameters.fields.items()}, **small()}
    found = flight.predict({"path": [made], "sun": [], "surfaces": []}, params)
    assert found.known
    assert found.bytes == 12 * 6 * 16 * 10 * 3


# Films as files.


def moving(count: int, rows: int = 48, cols: int = 64, rate: float = 12.0, *, closed: bool = False) -> Film:
    y, x = np.mgrid[0:rows, 0:cols]
    frames = []
    for number in range(count):
        red = 128 + 100 * np.sin(x / 9 + number / 3)
        blue = 128 + 100 * np.cos(y / 7 - number / 4)
        frames.append(Image(np.stack([red, (red + blue) / 2, blue], axis=2).astype(np.uint8), HILLS.extent))
    return Film(tuple(frames), rate, closed)


# The reader of imageio-ffmpeg leaves its pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_mp4_has_every_frame_at_its_size_and_place(tmp_path):
    film = moving(17)
    file = save_film(film, name="a/film.mp4", quality=10)
    target = tmp_path / "film.mp4"
    target.write_bytes(file.content.tobytes())
    reader = imageio_ffmpeg.read_frames(str(target))
    about = next(reader)
    frames = [np.frombuffer(frame, np.uint8).reshape(48, 64, 3) for frame in reader]
    assert about["size"] == (64, 48)
    assert about["fps"] == pytest.approx(12)
    assert about["codec"] == "h264"
    assert "yuv420p" in about["pix_fmt"]
    assert len(frames) == 17
    for number, frame in enumerate(frames):
        errors = [np.abs(frame.astype(float) - other.data).mean() for other in film.frames]
        assert int(np.argmin(errors)) == number
        assert errors[number] < 6
    assert np.array_equal(file.content, save_film(film, name="a/film.mp4", quality=10).content)
    assert len(save_film(film, name="film.mp4", quality=40).content) < len(file.content)


@pytest.mark.parametrize("closed", [False, True])
def test_a_gif_has_every_frame_and_takes_as_long_as_it_should(closed):
    film = moving(14, rate=30.0, closed=closed)
    made = Pillow.open(io.BytesIO(save_film(film, name="film.gif").content.tobytes()))
    assert made.n_frames == 14
    assert made.size == (64, 48)
    assert made.info.get("loop") == (0 if closed else None)
    took = 0
    for number in range(14):
        made.seek(number)
        took += made.info["duration"]
        apart = np.abs(np.asarray(made.convert("RGB")).astype(float) - film.frames[number].data)
        assert apart.mean() < 8
    assert took == round(14 / 30 * 100) * 10


def test_pngs_keep_every_value():
    film = moving(3)
    file = save_film(film, name="frames/f.png")
    assert [item.name for item in file.all()] == [f"frames/f_{number:04}.png" for number in range(3)]
    for item, frame in zip(file.all(), film.frames, strict=True):
        assert np.array_equal(np.asarray(Pillow.open(io.BytesIO(item.content.tobytes()))), frame.data)


@pytest.mark.parametrize(
    ("film", "name", "message"),
    [
        (moving(2), "film.avi", "mp4, .gif or .png"),
        (moving(2, rows=47), "film.mp4", "even"),
        (moving(2, rate=60.0), "film.gif", "50 frames a second"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(film, name, message):
    with pytest.raises(ValueError, match=message):
        save_film(film, name=name)


def test_films_are_of_one_size():
    with pytest.raises(ValueError, match="one size"):
        Film((moving(1).frames[0], moving(1, rows=20).frames[0]), 12.0)
    with pytest.raises(ValueError, match="one frame or more"):
        Film((), 12.0)
