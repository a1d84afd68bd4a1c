"""Ridges: crests along a curve, with flanks that grow gentler towards their foot (section 4.1)."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from nodegraph import Param, node
from nodegraph_tree.curve import CurvePoints, built
from nodegraph_tree.disc import Relief
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.function import ElevationFunction
from nodegraph_tree.geometry import CurveKind
from nodegraph_tree.layout import Stations, joined, line_of
from nodegraph_tree.profile import Section
from nodegraph_tree.union import union


@node(version=1)
def ridge(
    *,
    points: CurvePoints,
    spurs: Annotated[tuple[CurvePoints, ...], Param("Side ridges, each a list of points from its far end.")] = (),
    kind: Annotated[
        CurveKind, Param("What the points mean: corners, Bezier control points, or a spline.")
    ] = "catmull_rom",
    height: Annotated[float, Param("Height of the crest where it starts, for points without one.", unit="m")] = 500.0,
    slope: Annotated[float, Param("Rise of the crest along it, for points without height.", ge=-10, le=10)] = 0.0,
    radius: Annotated[float, Param("Half width of the ridge: where flanks and weight end.", gt=0, unit="m")] = 800.0,
    drop: Annotated[float, Param("How far the foot of the flanks lies below the crest.", ge=0, unit="m")] = 300.0,
    concavity: Annotated[
        float, Param("0: straight flanks; 1: steep at the crest, level at the foot.", ge=0, le=1)
    ] = 0.7,
    crest: Annotated[float, Param("Half width of the rounded crest; 0 leaves an edge.", ge=0, unit="m")] = 20.0,
    core: Annotated[float, Param("Up to where the weight is 1.", ge=0, unit="m")] = 0.0,
    roughness: Annotated[float, Param("Amplitude of noise on the ridge.", ge=0, unit="m")] = 0.0,
    wavelength: Annotated[float, Param("Size of the largest forms of the noise.", gt=0, unit="m")] = 400.0,
    octaves: Annotated[int, Param("How many scales of forms the noise has.", ge=1, le=16)] = 6,
    seed: Annotated[int, Param("Another number gives other noise.", ge=0, le=0xFFFFFFFF)] = 0,
    fall_off: Annotated[FallOff, Param("How the weight falls from 1 at the core to 0 at the radius.")] = "wyvill",
) -> ElevationFunction:
    r"""Lay a ridge along a curve, with spurs.

        f(p) = q_z - drop ((1 - v) x + v (2 x - x^2)) + roughness noise(p),   x = d / radius

    with v the concavity: the flanks fall by (1 + v) drop / radius at the crest and (1 - v) drop / radius at the foot.
    Within `crest` of the middle a parabola rounds the edge, and the whole is moved so that the crest stays at q_z.
    Spurs that end within the radius of what is there already are led to its nearest point and take its height.  Where
    ridges meet, the higher one is the ground (`nodegraph_tree.union`), and the gully between them is rounded.

    Args:
        points: of the crest, with or without heights.
        spurs: side ridges.
        kind: of all curves.
        height: of points without z.
        slope: of points without z.
        radius: of the support.
        drop: of the flanks.
        concavity: v.
        crest: less than the radius.
        core: less than the radius.
        roughness: of the noise, ridged multifractal.
        wavelength: of the noise.
        octaves: of the noise.
        seed: of the noise.
        fall_off: of the weight.

    Raises:
        ValueError: points that make no curve, or a crest or core that is as wide as the radius.

    Source: Génevaux et al. 2015, section 4.1, doi:10.1111/cgf.12530.
    """
    if crest >= radius or core >= radius:
        raise ValueError("crest and core must be less than radius")
    a, b = (1 + concavity) * drop / radius, concavity * drop / radius**2
    steep = a - 2 * b * crest
    # The parabola has the flank's slope at its end; all is measured from its top.
    flank = -0.5 * steep * crest
    rows = [[0.0, 0.0, 0.0, -0.5 * steep / crest]] if crest > 0 else []
    rows.append([crest, flank, -steep, b])
    width = radius - crest
    rows.append([radius, flank - width * (steep - b * width), 0.0, 0.0])
    side = np.array(rows)
    lines = [line_of(points, kind, height=height, slope=slope)]
    for index, spur in enumerate(spurs):
        line = line_of(spur, kind, height=height, slope=slope, what=f"spurs[{index}]")
        lines.append(joined(spur, line, lines, kind, radius, what=f"spurs[{index}]"))
    made = Stations((0.0,), (Section(side, side),), (radius,), (core,))
    relief = Relief("ridged" if roughness else "none", roughness, wavelength, octaves, seed=seed)
    x, y = lines[0].track.nodes[0].tolist()
    parts = [built(line, made, fall_off=fall_off, relief=relief, origin=(x, y)) for line in lines]
    # Crests meet over half the height that is rounded off them, feet over a good part of the flanks.
    near = max(0.25 * steep * crest, 0.01 * drop, 1e-3)
    return union(parts, near=near, far=max(0.2 * drop, near), upward=True)
