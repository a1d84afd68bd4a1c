from __future__ import annotations

import json

import numpy as np
import pytest

from nodegraph_terrain.raster import Extent, Image, Labels
from nodegraph_texture.colour_table import Colours
from nodegraph_texture.coverage import Coverage
from nodegraph_texture.surface_classes import classes_of
from nodegraph_texture.texture_report import texture_report

BOX = Extent(0, 0, 40, 30)
COLOURS = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200]], np.uint8)
TRUTH = np.random.default_rng(1).integers(0, 3, (30, 40)).astype(np.int32)
LABELS = Labels(TRUTH, BOX)
IMAGE = Image(COLOURS[TRUTH], BOX)
CLASSES = classes_of(
    ("red", "green", "blue"),
    [
        Colours(np.array([(r << 16) + (g << 8) + b], np.uint32), np.array([(i == TRUTH).sum()]))
        for i, (r, g, b) in enumerate(COLOURS.tolist())
    ],
)


def numbers(report):
    return json.loads(bytes(report.file.sidecars[0].content))


def test_a_perfect_reproduction():
    report = texture_report(IMAGE, IMAGE, LABELS, CLASSES)
    assert (report.agreement, report.kappa, report.colour_error) == (1.0, 1.0, 0.0)
    assert report.file.name == "report.png"
    found = numbers(report)
    assert found["cells"] == 1200
    assert [item["cells"] for item in found["classes"]] == np.bincount(TRUTH.ravel()).tolist()
    assert all(item["found"] == item["right"] == 1 for item in found["classes"])


def test_numbers_by_hand():
    made = TRUTH.copy()
    made[:15] = 0
    report = texture_report(IMAGE, Image(COLOURS[made], BOX), LABELS, CLASSES, name="a/b.png", title="$5")
    assert report.agreement == pytest.approx((made == TRUTH).mean())
    wrong = made != TRUTH
    assert report.colour_error == pytest.approx(np.sqrt(wrong.mean() * 2 * (170 / 255) ** 2 / 3), rel=1e-5)
    found = numbers(report)
    assert found["classes"][0]["found"] == 1
    assert found["classes"][0]["right"] == pytest.approx((TRUTH == 0).sum() / (made == 0).sum())
    assert found["confusion"][1] == [int(((TRUTH == 1) & (made == i)).sum()) for i in range(3)]
    assert report.file.sidecars[0].name == "a/b.json"


def test_coverage_decides_where_it_is_there_and_variants_belong_to_their_class():
    covers = np.zeros((30, 40, 4), np.float32)
    covers[..., 0] = 1
    covers[..., 1][TRUTH == 1] = 1
    covers[..., 2][TRUTH == 1] = 1
    covers[..., 3][TRUTH == 2] = 0.6
    four = Coverage(covers, BOX, ("red", "green", "green / 1", "blue"), ((0, 0, 0),) * 4)
    dark = Image(np.zeros((30, 40, 3), np.uint8), BOX)
    assert texture_report(IMAGE, dark, LABELS, CLASSES, four).agreement == 1


def test_finer_textures_are_brought_to_the_cells_and_held_out_cells_left_out():
    fine = Image(np.kron(IMAGE.data, np.ones((4, 4, 1), np.uint8)), BOX)
    assert texture_report(IMAGE, fine, LABELS, CLASSES).colour_error == 0
    broken = IMAGE.data.copy()
    broken[:10] = 0
    part = Labels(np.where(np.arange(30)[:, None] < 10, -1, TRUTH), BOX)
    report = texture_report(IMAGE, Image(broken, BOX), part, CLASSES)
    assert (report.agreement, report.colour_error) == (1, 0)
    assert numbers(report)["cells"] == 800


def test_bad_input_is_one_sentence():
    with pytest.raises(ValueError, match=r"must end in \.png"):
        texture_report(IMAGE, IMAGE, LABELS, CLASSES, name="a.jpg")
    with pytest.raises(ValueError, match="make it finer"):
        texture_report(IMAGE, Image(IMAGE.data[::2, ::2], BOX), LABELS, CLASSES)
    with pytest.raises(ValueError, match="different ground"):
        texture_report(IMAGE, Image(IMAGE.data, Extent(0, 0, 40, 60)), LABELS, CLASSES)
    with pytest.raises(ValueError, match="no cell with a label is opaque"):
        texture_report(IMAGE, IMAGE, Labels(np.full((30, 40), -1, np.int32), BOX), CLASSES)
    layers = Coverage(np.ones((30, 40, 1), np.float32), BOX, ("snow",), ((0, 0, 0),))
    with pytest.raises(ValueError, match="no layer has the name of a class"):
        texture_report(IMAGE, IMAGE, LABELS, CLASSES, layers)
