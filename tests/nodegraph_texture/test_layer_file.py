"""Layers as JSON: the same back, and every problem with its place."""

from __future__ import annotations

import json
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import codec
from nodegraph_texture.constraints import Hat, Sampled
from nodegraph_texture.layer import layer
from nodegraph_texture.layer_file import read, written
from nodegraph_texture.layers import Roughness, SurfaceLayers
from nodegraph_texture.load_layers import load_layers
from nodegraph_texture.save_layers import save_layers

numbers = st.floats(allow_nan=False, allow_infinity=False)
names = st.text(st.characters(blacklist_categories=["Cs"]), min_size=1, max_size=8).filter(str.strip)
quantities = st.sampled_from(["altitude", "slope", "temperature", "my_map2"])
shares = st.floats(0, 1)


@st.composite
def hats(draw):
    a, b, c, d = sorted(draw(st.lists(numbers, min_size=4, max_size=4)))
    rise = draw(st.sampled_from([(a, b), (-inf, -inf)]))
    fall = draw(st.sampled_from([(c, d), (inf, inf)]))
    return Hat(draw(quantities), *draw(st.sampled_from([(rise, fall), ((inf, inf),) * 2, ((-inf, -inf),) * 2])))


@st.composite
def sampled(draw):
    low, high = sorted(draw(st.lists(numbers, min_size=2, max_size=2, unique=True)))
    samples = draw(st.lists(st.floats(0, 1, width=32), min_size=2, max_size=300))
    return Sampled(draw(quantities), low, high, np.array(samples, np.float32))


roughness = st.builds(
    Roughness,
    st.sampled_from(["fbm", "ridged", "warped"]),
    st.floats(1e-3, 1e9),
    st.integers(1, 24),
    st.floats(0, 2),
    st.integers(0, 2**32 - 1),
)
colours = st.one_of(
    st.tuples(shares, shares, shares), st.tuples(*[st.integers(0, 255).map(lambda code: code / 255)] * 3)
)


@st.composite
def hierarchies(draw):
    unique = draw(st.lists(names, min_size=1, max_size=5, unique=True))
    made: list[SurfaceLayers] = []
    for name in unique:
        children = tuple(made) if draw(st.booleans()) else ()
        made = [] if children else made
        made.append(
            SurfaceLayers(
                name, draw(colours), tuple(draw(st.lists(st.one_of(hats(), sampled()), max_size=2))), draw(roughness),
                draw(numbers), draw(numbers), draw(roughness), draw(numbers), draw(roughness), draw(shares), children,
            )
        )  # fmt: skip
    return SurfaceLayers("the root of all", draw(colours), children=tuple(made))


@given(hierarchies())
@settings(max_examples=60, deadline=None)
def test_what_is_written_reads_the_same_to_the_bit(layers):
    text = written(layers)
    back = read(text, "layers.json")
    assert codec.seal(back) == codec.seal(layers)
    assert written(back) == text
    assert max(map(len, text.splitlines())) <= 200


def test_nodes_write_and_read(tmp_path):
    layers = layer(layer(name="snow", colour="white", altitude=(2000, 2200, None, None)), name="rock", colour="#706050")
    file = save_layers(layers, name="sub/layers.json")
    path = tmp_path / "layers.json"
    path.write_bytes(bytes(file.content))
    assert codec.seal(load_layers(path=path)) == codec.seal(layers)
    data = json.loads(path.read_text())
    assert data["format"] == "nodegraph-layers/1"
    assert data["layers"]["children"][0]["constraints"][0]["hat"] == [2000, 2200, None, None]
    with pytest.raises(ValueError, match=r"must end in \.json"):
        save_layers(layers, name="layers.yaml")


def test_what_a_person_writes_is_short():
    text = '{"format": "nodegraph-layers/1", "layers": {"name": "a", "colour": "sienna", "roughness": 2}}'
    assert read(text, "x").roughness == 2
    assert read(text, "x").noise == Roughness() or codec.seal(read(text, "x").noise) == codec.seal(Roughness())


def test_every_problem_is_told_with_its_place():
    data = {
        "format": "nodegraph-layers/1",
        "layers": {
            "name": "rock",
            "color": "#706050",
            "scale": "much",
            "relief": {"kind": "fractal", "octaves": 2.5, "wavelenght": 3},
            "children": [
                {"name": 3, "colour": "reddish"},
                {"name": "b", "colour": [0, 1], "noise": {"octaves": 99}},
                {"name": "c", "colour": "#000000", "constraints": [
                    {"quantity": "altitude", "hat": [3, 2, 4, 5]},
                    {"quantity": "Slope!", "hat": [0, 1, 2]},
                    {"quantity": "wetness", "low": 0, "high": 9, "samples": [0, 2]},
                    {"quantity": "wetness", "samples": "many"},
                    [],
                ]},
                7,
            ],
        },
    }  # fmt: skip
    with pytest.raises(ValueError) as caught:
        read(json.dumps(data), "bad.json")
    lines = str(caught.value).splitlines()
    assert lines[0].startswith("'bad.json' holds no layers")
    places = [
        "layers: there is no key 'color'; did you mean 'colour'?",
        "layers: the key 'colour' is missing",
        'layers.scale: must be a number, not "much"',
        "layers.relief: there is no key 'wavelenght'; did you mean 'wavelength'?",
        "layers.relief.kind: 'fractal' is none of",
        "layers.relief.octaves: must be a whole number, not 2.5",
        "layers.children[0].name: must be a text, not 3",
        "layers.children[0].colour: 'reddish' is no colour",
        'layers.children[1].colour: must be "#rrggbb" or three numbers from 0 to 1',
        "layers.children[1].noise: octaves = 99",
        "layers.children[2].constraints[0]: the hat of altitude must have four ends in rising order",
        "layers.children[2].constraints[1].quantity: 'Slope!' is no name of a quantity",
        "layers.children[2].constraints[1].hat: must have four numbers, not 3",
        "layers.children[2].constraints[2]: the samples of wetness must lie in 0 to 1",
        "layers.children[2].constraints[3]: the key 'low' is missing",
        "layers.children[2].constraints[4]: must be an object",
        "layers.children[3]: must be an object {...}, not 7",
    ]
    for place in places:
        assert any(line.startswith(place) for line in lines), (place, lines)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("{", "not JSON"),
        ("[1]", "must be an object"),
        ('{"format": "nodegraph-layers/9", "layers": {}}', "is not 'nodegraph-layers/1'"),
        ('{"layers": {"name": "a", "colour": "red"}}', "the key 'format' is missing"),
        ('{"format": "nodegraph-layers/1", "layers": {"name": "a", "colour": "red", "scale": NaN}}', "NaN"),
        (
            '{"format": "nodegraph-layers/1", "layers": {"name": "a", "colour": "red", "children": '
            '[{"name": "a", "colour": "red"}]}}',
            "two layers are called 'a'",
        ),
    ],
)
def test_damaged_files_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        read(text, "damaged.json")


def test_a_deep_hierarchy_is_written_or_refused():
    layers = layer(name="0", colour="red")
    for level in range(1, 24):
        layers = layer(layers, name=str(level), colour="red")
    assert codec.seal(read(written(layers), "deep")) == codec.seal(layers)
    with pytest.raises(ValueError, match="24 levels"):
        written(layer(layers, name="24", colour="red"))
