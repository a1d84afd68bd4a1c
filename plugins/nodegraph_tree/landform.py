"""Ready contour primitives: lakes, mesas and impact craters."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from nodegraph import Param, node
from nodegraph_tree.contour import Contour, Outline, around, wheel
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.function import THRESHOLD, ElevationFunction, Points
from nodegraph_tree.geometry import Floats
from nodegraph_tree.profile import section

_Centre = Annotated[tuple[float, float], Param("Centre [x, y].", unit="m")]
_Radius = Annotated[float, Param("Of the outline, without points.", gt=0, unit="m")]
_Uneven = Annotated[float, Param("How far an outline without points strays from a circle.", ge=0, le=0.8)]
_Seed = Annotated[int, Param("Another number gives another outline.", ge=0, le=0xFFFFFFFF)]
_Fall = Annotated[FallOff, Param("How the weight falls from 1 to 0.")]


@node(version=1)
def lake(
    terrain: ElevationFunction | None = None,
    *,
    centre: _Centre = (0.0, 0.0),
    points: Outline = None,
    radius: _Radius = 200.0,
    unevenness: _Uneven = 0.3,
    level: Annotated[
        float | None, Param("Of the water; none: the lowest ground on the shore of a terrain, else 0.", unit="m")
    ] = None,
    depth: Annotated[float, Param("At the centre.", ge=0, unit="m")] = 15.0,
    shelf: Annotated[float, Param("Depth at half way from shore to centre, as a share.", ge=0, le=1)] = 0.7,
    bank: Annotated[float, Param("Height of the bank above the water at the outer end.", ge=0, unit="m")] = 3.0,
    reach: Annotated[float, Param("Where the bank ends and the weight reaches 0, in radii.", gt=1)] = 1.5,
    seed: _Seed = 0,
    fall_off: _Fall = "cubic",
) -> ElevationFunction:
    """Make the bed and banks of a lake.

    Inside the shore f = level - depth at the centre, - depth shelf at u = 1/2 and 0 at u = 1 (u as in `contour`); from
    there the bank rises to `bank` at the reach.  The weight is 1 up to 5 % beyond the shore.  The water itself is a
    constant at `level`: link a `constant` to where water is drawn.

    Args:
        terrain: where the level comes from.
        centre: inside the shore.
        points: of the shore; seen from the centre they must go round once.
        radius: of the shore without points.
        unevenness: of a shore without points.
        level: of the water.
        depth: at the centre.
        shelf: 0: a shelf along the shore; 1: steep shores, flat bed.
        bank: above the water.
        reach: of the support.
        seed: of the shore.
        fall_off: of the weight.

    Raises:
        ValueError: a shore that does not go round its centre once, or that leaves the terrain.

    Source: Génevaux et al. 2015, section 4.1 and figure 7, doi:10.1111/cgf.12530.
    """
    outline = around(centre, points, 0.0) if points is not None else uneven(radius, unevenness, seed)
    if level is None:
        level = 0.0 if terrain is None else float(_ground(terrain, centre, outline, 1.0, "lake").min())
    inside = [(0.0, -depth), (0.5, -depth * shelf), (1.0, 0.0)]
    rise = section([*inside, (0.5 * (1 + reach), 0.4 * bank), (reach, bank)])
    core = min(1.05, 0.5 * (1 + reach))
    return Contour(centre[0], centre[1], level, 0.0, outline, (0.0,), (rise,), core, reach, fall_off)


@node(version=1)
def mesa(
    *,
    centre: _Centre = (0.0, 0.0),
    points: Outline = None,
    radius: _Radius = 300.0,
    unevenness: _Uneven = 0.35,
    height: Annotated[float, Param("Of the ground around.", unit="m")] = 0.0,
    rise: Annotated[float, Param("Of the top above the ground.", unit="m")] = 120.0,
    cliff: Annotated[float, Param("Width of the cliff, in radii.", gt=0, le=0.5)] = 0.08,
    talus: Annotated[float, Param("Height of the talus below the cliff, as a share of the rise.", ge=0, le=1)] = 0.35,
    reach: Annotated[float, Param("Where the talus ends and the weight reaches 0, in radii.", gt=1.01)] = 1.6,
    seed: _Seed = 0,
    fall_off: _Fall = "cubic",
) -> ElevationFunction:
    """Make a mesa: a flat top, a cliff at the outline, and talus that runs out into the ground.

    f = height + rise up to u = 1 - cliff (u as in `contour`), then falls to height + talus rise at u = 1 and to height
    at the reach.

    Args:
        centre: inside the outline.
        points: of the foot of the cliff; seen from the centre they must go round once.
        radius: of the outline without points.
        unevenness: of the outline without points.
        height: of the ground.
        rise: of the top; negative for a sink.
        cliff: of the outline's radius.
        talus: of the rise.
        reach: of the support.
        seed: of the outline.
        fall_off: of the weight.

    Raises:
        ValueError: an outline that does not go round its centre once.

    Source: Génevaux et al. 2015, section 4.1, doi:10.1111/cgf.12530.
    """
    outline = around(centre, points, 0.0) if points is not None else uneven(radius, unevenness, seed)
    edge = 1 - cliff
    half = 0.5 * (1 + reach)
    rows = [
        (0.0, rise), (edge - 0.3 * cliff, rise), (edge, 0.985 * rise), (1.0, talus * rise), (half, 0.3 * talus * rise),
        (reach, 0.0),
    ]  # fmt: skip
    side = section(rows)
    return Contour(centre[0], centre[1], height, 0.0, outline, (0.0,), (side,), 1.0, reach, fall_off)


@node(version=1)
def crater(
    terrain: ElevationFunction | None = None,
    *,
    centre: _Centre = (0.0, 0.0),
    radius: Annotated[float, Param("Of the rim.", gt=0, unit="m")] = 250.0,
    unevenness: _Uneven = 0.05,
    height: Annotated[
        float | None, Param("Of the ground; none: the mean on the rim of a terrain, else 0.", unit="m")
    ] = None,
    depth: Annotated[float, Param("From rim to floor, in radii.", ge=0, le=2)] = 0.4,
    rim: Annotated[float, Param("Height of the rim above the ground, in radii.", ge=0, le=1)] = 0.08,
    peak: Annotated[
        float, Param("Height of a central peak above the floor, as a share of the depth.", ge=0, le=1)
    ] = 0.0,
    reach: Annotated[float, Param("Where the ejecta end and the weight reaches 0, in radii.", gt=1.2)] = 2.5,
    seed: _Seed = 0,
    fall_off: _Fall = "cubic",
) -> ElevationFunction:
    """Make an impact crater: a bowl, a raised rim, and ejecta that thin out with the cube of the distance.

    f = height + rim - depth (1 - u^2) inside (flat-floored with a central peak), height + rim u^-3 outside, u as in
    `contour`; lengths of `depth` and `rim` in radii.  The weight is 1 up to the rim.  Replace a terrain by many
    in order (`tree.replace`): the last impact wins.

    Args:
        terrain: where the ground's height comes from.
        centre: of the crater.
        radius: of the rim.
        unevenness: of the rim.
        height: of the ground.
        depth: fresh simple craters have 0.4.
        rim: fresh simple craters have 0.08.
        peak: of complex craters.
        reach: of the support.
        seed: of the rim.
        fall_off: of the weight.

    Raises:
        ValueError: a crater that leaves the terrain.

    Source: Génevaux et al. 2015, section 4.1 and figure 12, doi:10.1111/cgf.12530.  Proportions: Pike 1977, Impact and
    Explosion Cratering; ejecta: McGetchin et al. 1973, doi:10.1016/0012-821X(73)90162-3.
    """
    outline = uneven(radius, unevenness, seed)
    if height is None:
        height = 0.0 if terrain is None else float(_ground(terrain, centre, outline, 1.0, "crater").mean())
    top, deep = rim * radius, depth * radius
    bowl = [(u, top - deep * (1 - u * u)) for u in (0.0, 0.25, 0.5, 0.7, 0.85, 0.95)]
    if peak > 0:
        floor = top - deep
        bowl = [
            (0.0, floor + peak * deep), (0.08, floor + 0.75 * peak * deep), (0.2, floor + 0.08 * peak * deep),
            (0.28, floor), (0.55, floor), (0.75, top - 0.62 * deep), (0.93, top - 0.12 * deep),
        ]  # fmt: skip
    ejecta = [(u, top / u**3) for u in (1.08, 1.2, 1.4, 1.7, 2.1) if u < reach]
    side = section([*bowl, (1.0, top), *ejecta, (reach, top / reach**3)])
    core = min(1.05, 0.5 * (1 + reach))
    return Contour(centre[0], centre[1], height, 0.0, outline, (0.0,), (side,), core, reach, fall_off)


def uneven(radius: float, unevenness: float, seed: int) -> Floats:
    """Return an outline of 24 radii: a circle with five harmonics, of a mean deviation of a third of `unevenness`."""
    if unevenness == 0:
        return wheel(radius)
    dice = np.random.default_rng(seed)
    theta = np.arange(24) * 2 * np.pi / 24
    wave = np.zeros(24)
    for order in range(2, 7):
        wave += np.sin(order * theta + dice.uniform(0, 2 * np.pi)) * dice.uniform(0.5, 1.0) / order
    return wheel((radius * (1 + unevenness * np.clip(wave, -1.1, 1.1))).tolist())


def _ground(terrain: ElevationFunction, centre: tuple[float, float], outline: Floats, u: float, what: str) -> Floats:
    """Return the heights of a terrain along an outline."""
    probe = Contour(centre[0], centre[1], 0.0, 0.0, outline, (0.0,), (section([(0.0, 0.0)]),), 0.0, 1.0)
    theta = np.arange(256) * 2 * np.pi / 256
    rho = u * probe.radius(theta)
    sample = terrain.query(Points(centre[0] + rho * np.cos(theta), centre[1] + rho * np.sin(theta)))
    if (sample.weight < THRESHOLD).any():
        raise ValueError(f"the {what} leaves its terrain; give its height, or a terrain that reaches around it")
    return sample.height
