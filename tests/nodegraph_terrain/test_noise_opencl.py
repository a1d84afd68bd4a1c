"""`noise.h` on the device beside its definition in float64."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nodegraph_terrain.noise
from nodegraph_terrain.gradient_noise import gradient_noise
from nodegraph_terrain.noise import KINDS, MOST, Noise, Sample

INCLUDE = (Path(nodegraph_terrain.noise.__file__).parent,)
DEFINES = {"FORM": 0, "KIND": "noise_fbm", "KIND_SLOPES": "noise_fbm_slopes"}

PROBE = """
#include "noise.h"
#include "vectors.h"

// Offsets (x, y) from one origin, eight at a time: four forms of the sum of any kind, and two of a stated kind.
__kernel void probe(__global const uint *words, int first, __global const uint *origins, int which,
                    __global const float *x, __global const float *y, __global const float *kappa,
                    __global float *value, __global float *east, __global float *north)
{
    const int at = get_global_id(0) * 8;
    __global const NoiseSum *sum = noise_at(words, first);
    __global const NoiseOrigin *origin = noise_origin(origins, (size_t)which * noise_lattices(sum));
    const float8 px = get8(x + at), py = get8(y + at), level = get8(kappa + at);
    float8 n, ex = 0.0f, ny = 0.0f;
    switch (FORM) {
    case 0: n = noise_value(sum, origin, px, py); break;
    case 1: n = noise_value_lod(sum, origin, px, py, level); break;
    case 2: n = noise_slopes(sum, origin, px, py, &ex, &ny); break;
    case 3: n = noise_slopes_lod(sum, origin, px, py, level, &ex, &ny); break;
    case 4: n = KIND(sum, origin, px, py); break;
    default: n = KIND_SLOPES(sum, origin, px, py, &ex, &ny);
    }
    put8(n, value + at);
    put8(ex, east + at);
    put8(ny, north + at);
}

__kernel void plain(int2 cell, uint seed, __global const float *u, __global const float *v,
                    __global float *value, __global float *along_u, __global float *along_v)
{
    const int at = get_global_id(0) * 8;
    float8 du, dv;
    put8(noise_lattice(cell, get8(u + at), get8(v + at), seed, 1, &du, &dv), value + at);
    put8(du, along_u + at);
    put8(dv, along_v + at);
}
"""


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("noise") / "probe.cl"
    path.write_text(PROBE)
    return path


class Probe:
    """Points about an origin, on the device and in float64."""

    def __init__(self, device: Any, kernels: Path, seed: int = 0) -> None:
        self.device, self.kernels = device, kernels
        self.dice = np.random.default_rng(seed)

    def __call__(
        self, noise: Noise, origin: tuple[float, float], span: float, form: int, detail: float | None = None
    ) -> tuple[Sample, Sample]:
        x, y = self.dice.uniform(-span, span, (2, 256)).astype(np.float32)
        kappa = self.dice.uniform(0, 1, 256).astype(np.float32) if detail is None else np.full(256, detail, np.float32)
        # The table and the origins stand behind others.
        words = np.concatenate([np.full(24, 77, np.uint32), noise.table()])
        origins = noise.origins([0.0, origin[0]], [1.0, origin[1]]).ravel()
        defines: dict[str, Any] = {**DEFINES, "FORM": form}
        if form >= 4 and noise.kind != "gradient":
            defines.update(KIND=f"noise_{noise.kind}", KIND_SLOPES=f"noise_{noise.kind}_slopes")
        made = [self.device.empty(256) for _ in range(3)]
        inputs = [self.device.from_host(array) for array in (x, y, kappa)]
        self.device.run(
            self.kernels,
            "probe",
            32,
            self.device.from_host(words),
            24,
            self.device.from_host(origins),
            1,
            *inputs,
            *made,
            include=INCLUDE,
            defines=defines,
        )
        px, py = origin[0] + x.astype(float), origin[1] + y.astype(float)
        expected = noise.sample(px, py, kappa=kappa.astype(float) if form in (1, 3) else None)
        return Sample(*(self.device.to_host(array) for array in made)), expected


@pytest.fixture(scope="module")
def probe(device: Any, kernels: Path) -> Probe:
    return Probe(device, kernels)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cells", [0.0, 1e5, -1e8])
def test_agrees_with_the_definition(probe: Probe, kind: Any, cells: float) -> None:
    """At any distance the value is within 1e-5, and the gradient within 1e-5 of its bound."""
    noise = Noise(kind, 6, wavelength=800.0, seed=5)
    finest = 800.0 / 2**5 if noise.count > 1 else 800.0
    for form in range(6):
        own, expected = probe(noise, (cells * finest, -0.7 * cells * finest), 16 * finest, form)
        assert np.abs(own.value - expected.value).max() < 1e-5
        if form in (2, 3, 5):
            wrong = np.maximum(np.abs(own.east - expected.east), np.abs(own.north - expected.north))
            # On either side of a crease, of which few points are so near, gradients differ.
            assert np.quantile(wrong, 0.99) < 1e-5 * noise.lipschitz()


@pytest.mark.parametrize("kind", KINDS)
def test_digits_do_not_depend_on_the_distance_from_the_origin(probe: Probe, kind: Any) -> None:
    """Offsets may span hundreds of cells of the finest octave."""
    noise = Noise(kind, 5, wavelength=200.0, seed=5)
    for span in (2.0, 200.0, 8000.0):
        own, expected = probe(noise, (150_000.0, 150_000.0), span, 0)
        assert np.abs(own.value - expected.value).max() < 1e-6


@settings(max_examples=60)
@given(
    kind=st.sampled_from(KINDS),
    octaves=st.integers(1, 8),
    wavelength=st.floats(1e-3, 1e6),
    lacunarity=st.floats(1, 3),
    gain=st.floats(0, 1.2),
    feedback=st.floats(0, 4),
    warp=st.floats(0, 0.5),
    seed=st.integers(0, 2**32 - 1),
    cells=st.tuples(st.floats(-1.5e9, 1.5e9), st.floats(-5e8, 5e8)),
    form=st.integers(0, 1),
)
def test_agrees_whatever_the_parameters(
    probe: Probe,
    kind: Any,
    octaves: int,
    wavelength: float,
    lacunarity: float,
    gain: float,
    feedback: float,
    warp: float,
    seed: int,
    cells: tuple[float, float],
    form: int,
) -> None:
    noise = Noise(kind, octaves, wavelength, lacunarity, gain, seed, feedback, warp)
    finest = 1 / max(lattice.frequency for lattice in noise.lattices)
    # Coordinates that float64 holds to 2^-23 of a cell.
    origin = tuple(cell * finest for cell in cells)
    own, expected = probe(noise, (origin[0], origin[1]), 4 * finest, form)
    # Errors of float32 pass through the weights of a multifractal and the displacement of a warped noise.
    passed = (1 + feedback) ** 2 if kind in ("ridged", "hybrid") else 1 + warp * noise.lipschitz() * wavelength
    assert np.abs(own.value - expected.value).max() < 1e-5 * passed


def test_most_octaves_and_level_ground(probe: Probe) -> None:
    noise = Noise("ridged", MOST, 1e7, seed=1)
    own, expected = probe(noise, (5e5, 5e6), 10.0, 0)
    assert np.abs(own.value - expected.value).max() < 1e-5
    own, _ = probe(noise, (5e5, 5e6), 10.0, 3, detail=0.0)
    assert not np.any(own)
    whole, expected = probe(noise, (5e5, 5e6), 10.0, 1, detail=1.0)
    np.testing.assert_array_less(np.abs(whole.value - expected.value), 1e-5)


def test_parameters_do_not_compile_anew(probe: Probe) -> None:
    probe(Noise("fbm", 3, 10.0), (0.0, 0.0), 10.0, 0)
    before = probe.device.builds
    for noise in (Noise("billow", 7, 500.0, seed=3), Noise("warped", 2, 3.0, gain=0.9), Noise("fbm", 8, 20.0, 1.5)):
        probe(noise, (0.0, 0.0), 10.0, 0)
    assert probe.device.builds == before


@pytest.mark.parametrize("cell", [(0, 0), (2**30, -(2**30)), (-(2**31) + 2**12, 2**31 - 2**12)])
def test_a_lattice_of_ones_own(device: Any, kernels: Path, cell: tuple[int, int]) -> None:
    # Multiples of 2^-20, so that float64 holds them that far out.
    u, v = (np.random.default_rng(4).integers(-9 << 20, 9 << 20, (2, 64)) / 2**20).astype(np.float32)
    made = [device.empty(64) for _ in range(3)]
    arguments = (cell, 2**32 - 5, device.from_host(u), device.from_host(v), *made)
    device.run(kernels, "plain", 8, *arguments, include=INCLUDE, defines=DEFINES)
    expected = gradient_noise(cell[0] + u.astype(float), cell[1] + v.astype(float), 2**32 - 5, True)
    for own, other in zip(made, expected, strict=True):
        assert np.abs(device.to_host(own) - other).max() < 1e-5
