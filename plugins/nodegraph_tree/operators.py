"""The operators of construction trees as nodes: what combines, carves, places, warps and chooses trees (section 5)."""

from __future__ import annotations

from math import radians
from typing import Annotated

from nodegraph import Param, node
from nodegraph_tree import bend as bending
from nodegraph_tree import blend as blending
from nodegraph_tree import by_terrain as terrain_weights
from nodegraph_tree import distort as distorting
from nodegraph_tree import replace as replacing
from nodegraph_tree import twist as twisting
from nodegraph_tree.add import add as added
from nodegraph_tree.affine import placed
from nodegraph_tree.basic import Constant, Plane
from nodegraph_tree.carve import Carve
from nodegraph_tree.detail import LevelOfDetail
from nodegraph_tree.function import ElevationFunction, check_depth

Pair = tuple[float, float]


def _checked(tree: ElevationFunction) -> ElevationFunction:
    """Return a tree that is not nested too deep to be evaluated."""
    check_depth(tree)
    return tree


@node(version=1)
def constant(*, height: Annotated[float, Param("Height everywhere.", unit="m")] = 0.0) -> ElevationFunction:
    """Make level ground without an edge: f(p) = height, alpha(p) = 1.

    Args:
        height: of the ground, m.

    Source: Génevaux et al. 2015, section 3, doi:10.1111/cgf.12530.
    """
    return Constant(height)


@node(version=1)
def plane(
    *,
    height: Annotated[float, Param("Height at the origin point.", unit="m")] = 0.0,
    origin: Annotated[Pair, Param("Where the plane has that height (x, y).", unit="m")] = (0.0, 0.0),
    east: Annotated[float, Param("Rise towards the east, metres per metre.")] = 0.0,
    north: Annotated[float, Param("Rise towards the north, metres per metre.")] = 0.0,
) -> ElevationFunction:
    """Make tilted ground without an edge: f(p) = height + (east, north) . (p - origin), alpha(p) = 1.

    Args:
        height: at the origin point, m.
        origin: (x, y), m.
        east: slope towards the east, m/m.
        north: slope towards the north, m/m.

    Source: Génevaux et al. 2015, section 3, doi:10.1111/cgf.12530.
    """
    return Plane(height - east * origin[0] - north * origin[1], east, north)


@node(version=1)
def blend(*parts: ElevationFunction) -> ElevationFunction:
    """Blend any number of trees into one terrain: their mean, weighted by how much each is there.

        f = sum alpha_i f_i / sum alpha_i,   alpha = sum alpha_i

    Far from each other they keep their shapes, closer by they run into each other.  Associative and commutative: blends
    of blends become one, and the order does not matter.  Bounds hold with the factor 1 / alpha in the gradient that the
    appendix drops.  O(parts that reach the sample).

    Args:
        parts: at least one tree.

    Raises:
        ValueError: nothing is linked, or the tree is nested too deep.

    Source: Génevaux et al. 2015, section 5.1, doi:10.1111/cgf.12530.
    """
    if not parts:
        raise ValueError("nothing is linked to be blended; link at least one tree")
    return _checked(blending.blend(parts))


@node(version=1)
def replace(
    base: ElevationFunction,
    *layers: ElevationFunction,
    grow: Annotated[bool, Param("Let the layers reach beyond the base: alpha = (1 - a) alpha_A + a^2.")] = False,
) -> ElevationFunction:
    """Put layers in the place of what lies below them, one after the other: lakes, roads, craters.

        f = (1 - a) f_A + a f_B,  a = min(alpha_B, 1);   alpha = alpha_A, or with `grow` (1 - a) alpha_A + a^2

    Weights above 1 are held at 1, where the printed formula would overshoot.  With `grow`, and beyond the terrain of
    the base (alpha_A < 1/2), where its height means nothing, the base counts by s (2 - s), s = 2 alpha_A, so that
    nothing jumps where it ends.

    Args:
        base: A, the ground.
        layers: B, the last one on top.
        grow: whether the weights of the layers count.

    Raises:
        ValueError: the tree is nested too deep.

    Source: Génevaux et al. 2015, section 5.2, doi:10.1111/cgf.12530.
    """
    return _checked(replacing.replace(base, layers, grow=grow))


@node(version=1)
def add(
    base: ElevationFunction,
    *details: ElevationFunction,
    grow: Annotated[bool, Param("Let the details reach beyond the base: alpha = alpha_A + alpha_B^2.")] = False,
) -> ElevationFunction:
    """Add details to the heights of a ground: dunes, ripples, boulders.

        f = f_A + alpha_B f_B;   alpha = alpha_A, or with `grow` alpha_A + alpha_B^2

    The heights of a detail are differences.  With `grow`, and beyond the terrain of the base, where its height means
    nothing, f_A is multiplied by s (2 - s), s = 2 alpha_A.

    Args:
        base: A, the ground.
        details: B, each on top of the ones before.
        grow: whether the weights of the details count.

    Raises:
        ValueError: the tree is nested too deep.

    Source: Génevaux et al. 2015, section 5.3, doi:10.1111/cgf.12530.
    """
    return _checked(added(base, details, grow=grow))


_SMOOTH = Param("Over what difference in height the edge is rounded; 0 is sharp.", ge=0, unit="m")


@node(version=1)
def carve(
    base: ElevationFunction,
    *tools: ElevationFunction,
    smooth: Annotated[float, _SMOOTH] = 0.0,
) -> ElevationFunction:
    """Lower a ground to other trees where they are lower, and never raise it: valleys, quarries, cuttings.

        f = f_A - a m(f_A - f_B),  a = min(alpha_B, 1),  m(d) = max(d, 0),   alpha = alpha_A

    With `smooth` = k the edge is rounded: m(d) = (d + k)^2 / (4 k) for |d| < k, which has a continuous slope and goes
    up to k / 4 deeper.

    Args:
        base: A, the ground.
        tools: B, one after the other.
        smooth: k, m.

    Raises:
        ValueError: the tree is nested too deep.

    Source: replacement (Génevaux et al. 2015, section 5.2, doi:10.1111/cgf.12530) held below the ground.
    """
    for tool in tools:
        base = Carve(base, tool, smooth, False)
    return _checked(base)


@node(version=1)
def pile(
    base: ElevationFunction,
    *tools: ElevationFunction,
    smooth: Annotated[float, _SMOOTH] = 0.0,
) -> ElevationFunction:
    """Raise a ground to other trees where they are higher, and never lower it: dams, moraines, spoil heaps.

        f = f_A + a m(f_B - f_A),  a = min(alpha_B, 1),  m(d) = max(d, 0),   alpha = alpha_A

    The opposite of `carve`, with the same rounding.

    Args:
        base: A, the ground.
        tools: B, one after the other.
        smooth: k, m.

    Raises:
        ValueError: the tree is nested too deep.

    Source: replacement (Génevaux et al. 2015, section 5.2, doi:10.1111/cgf.12530) held above the ground.
    """
    for tool in tools:
        base = Carve(base, tool, smooth, True)
    return _checked(base)


@node(version=1)
def weight_by_terrain(
    function: ElevationFunction,
    terrain: ElevationFunction,
    *,
    lowest: Annotated[float | None, Param("Full weight from this altitude on; none: no lower end.", unit="m")] = None,
    highest: Annotated[float | None, Param("Full weight up to this altitude; none: no upper end.", unit="m")] = None,
    altitude_fade: Annotated[float, Param("Height over which it fades beyond the ends.", gt=0, unit="m")] = 50.0,
    gentlest: Annotated[
        float | None, Param("Full weight from this slope on; none: from 0.", ge=0, lt=89, unit="deg")
    ] = None,
    steepest: Annotated[
        float | None, Param("Full weight up to this slope; none: up to 90.", ge=0, lt=90, unit="deg")
    ] = None,
    slope_fade: Annotated[float, Param("Slope over which it fades beyond the ends.", gt=0, le=90, unit="deg")] = 10.0,
    span: Annotated[float, Param("How far to each side the slope is measured.", gt=0, unit="m")] = 10.0,
) -> ElevationFunction:
    """Let a tree appear only where another one has certain altitudes and slopes: dunes below the rocks (figure 13).

        alpha = alpha_B h(f_A) s(|D f_A|)

    with smooth hats h and s, 1 between the ends and falling to 0 beyond them by 3 t^2 - 2 t^3.  f stays as it is.  Add
    or blend the result to the terrain.  Where the terrain ends, the weight fades to 0 with it.

    The slope is measured by central differences over `span`: |grad f_A| itself would need second derivatives for the
    gradient of the weight and have no bound.  So the gradient of the weight is exact, and what is smaller than the span
    does not count as slope.  With an end of the slope the terrain is asked five times for each sample, else once.

    Args:
        function: B, whose weight is multiplied.
        terrain: A, whose altitude and slope decide.
        lowest: altitude, m.
        highest: altitude, m.
        altitude_fade: m.
        gentlest: slope, degrees.
        steepest: slope, degrees.
        slope_fade: degrees.
        span: m.

    Raises:
        ValueError: an interval is empty, or the tree is nested too deep.

    Source: Génevaux et al. 2015, section 5.3 and figure 13, doi:10.1111/cgf.12530.
    """
    return _checked(
        terrain_weights.by_terrain(
            function,
            terrain,
            lowest=lowest,
            highest=highest,
            altitude_fade=altitude_fade,
            gentlest=gentlest,
            steepest=steepest,
            slope_fade=slope_fade,
            span=span,
        )
    )


@node(version=1)
def transform(
    function: ElevationFunction,
    *,
    position: Annotated[Pair, Param("Where its origin goes (x, y).", unit="m")] = (0.0, 0.0),
    rotation: Annotated[float, Param("Turn about its origin, counter-clockwise.", unit="deg")] = 0.0,
    size: Annotated[Pair, Param("Scales along its own axes; a negative one mirrors.")] = (1.0, 1.0),
    height_scale: Annotated[float, Param("What heights are multiplied by.")] = 1.0,
    rise: Annotated[float, Param("What is added to the heights then.", unit="m")] = 0.0,
) -> ElevationFunction:
    """Scale, turn and move a tree, and its heights: f(p) = height_scale f_A(M p) + rise, alpha(p) = alpha_A(M p).

    First scaled along its axes, then turned, then moved.  Transforms of transforms become one.  The same tree may be
    transformed any number of times: it is stored once.

    Args:
        function: A.
        position: m.
        rotation: degrees.
        size: not 0.
        height_scale: 1 keeps heights.
        rise: m.

    Raises:
        ValueError: a size is 0 or so small that the transform cannot be undone.

    Source: Génevaux et al. 2015, section 5.4 and figure 15, doi:10.1111/cgf.12530.
    """
    return _checked(placed(function, position=position, rotation=rotation, size=size, scale=height_scale, rise=rise))


@node(version=1)
def warp(
    function: ElevationFunction,
    *,
    amplitude: Annotated[float, Param("Greatest displacement along either axis.", unit="m")] = 50.0,
    wavelength: Annotated[float, Param("Size of the largest bends.", gt=0, unit="m")] = 1000.0,
    octaves: Annotated[int, Param("How many scales of bends, each half as wide.", ge=1, le=8)] = 1,
    gain: Annotated[float, Param("How much smaller each scale is than the one before.", ge=0, le=1)] = 0.3,
    seed: Annotated[int, Param("Another number gives another distortion.", ge=0, le=0xFFFFFFFF)] = 0,
) -> ElevationFunction:
    """Distort a tree by noise, so that repeated parts no longer look alike.

        f(p) = f_A(p + d(p)),   alpha(p) = alpha_A(p + d(p))

    d = amplitude (n_x, n_y), two sums of gradient noise within [-1, 1]: the displacement of the inverse warp, which is
    what evaluation needs.  It is one to one because |grad d| < 1 is asked for: amplitude below about a quarter of the
    wavelength for one octave.  An amplitude of 0 is the tree itself.

    Args:
        function: A.
        amplitude: m.
        wavelength: m.
        octaves: scales.
        gain: ratio of amplitudes.
        seed: of the noise.

    Raises:
        ValueError: the displacement may fold the ground; the message says what would not.

    Source: Génevaux et al. 2015, section 5.4 and figure 14, doi:10.1111/cgf.12530.
    """
    return _checked(
        distorting.distort(function, amplitude=amplitude, wavelength=wavelength, octaves=octaves, gain=gain, seed=seed)
    )


@node(version=1)
def twist(
    function: ElevationFunction,
    *,
    centre: Annotated[Pair, Param("About which it turns (x, y).", unit="m")] = (0.0, 0.0),
    radius: Annotated[float, Param("Beyond which nothing moves.", gt=0, unit="m")] = 1000.0,
    angle: Annotated[float, Param("Turn at the centre, counter-clockwise.", unit="deg")] = 90.0,
) -> ElevationFunction:
    """Twist a tree about a centre, by an angle that falls off with the distance as (1 - (r / radius)^2)^3.

    One to one whatever the angle, and exactly the tree itself beyond the radius.

    Args:
        function: the tree.
        centre: m.
        radius: m.
        angle: degrees.

    Raises:
        ValueError: the tree is nested too deep.

    Source: Génevaux et al. 2015, section 5.4, doi:10.1111/cgf.12530.
    """
    return _checked(twisting.twist(function, centre=centre, radius=radius, angle=radians(angle)))


@node(version=1)
def bend(
    function: ElevationFunction,
    *,
    start: Annotated[Pair, Param("Where the axis begins (x, y).", unit="m")] = (-1000.0, 0.0),
    end: Annotated[Pair, Param("Where the axis ends (x, y).", unit="m")] = (1000.0, 0.0),
    offsets: Annotated[
        tuple[float, ...],
        Param("How far points spaced along the axis move to its left.", min_length=1, max_length=32, unit="m"),
    ] = (200.0,),
    reach: Annotated[float, Param("Distance from the axis beyond which nothing moves.", gt=0, unit="m")] = 1000.0,
) -> ElevationFunction:
    """Bend a tree sideways along an axis, so that the straight axis becomes a smooth curve through the offsets.

    With s along the axis and t across it, points move by h(s) (1 - (t / reach)^2)^3 to the left; h is the cubic spline
    through the offsets, n of them at L / (n + 3) times 2, 3, ..., n + 1, which is 0 and level at both ends and beyond.

    Args:
        function: the tree.
        start: m.
        end: m.
        offsets: m, negative to the right.
        reach: m; at least 1.72 times the greatest offset.

    Raises:
        ValueError: the axis has no length, or the bend would fold the ground.

    Source: Génevaux et al. 2015, section 5.4, doi:10.1111/cgf.12530.
    """
    return _checked(bending.bend(function, start=start, end=end, offsets=offsets, reach=reach))


@node(version=1)
def level_of_detail(
    coarse: ElevationFunction,
    fine: ElevationFunction,
    *,
    start: Annotated[float, Param("Up to this level of detail, the coarse one.", ge=0, lt=1)] = 0.3,
    end: Annotated[float, Param("From this level of detail on, the fine one.", gt=0, le=1)] = 0.7,
) -> ElevationFunction:
    """Choose between a coarse and a fine tree by the level of detail kappa, with a smooth change between them.

        f = (1 - t) f_A + t f_B,  alpha = (1 - t) alpha_A + t alpha_B,  t = (kappa - k_A) / (k_B - k_A) within [0, 1]

    Only what the level of detail asks for is computed.  Where one of both has no terrain and its height means nothing,
    it fades out instead.

    Args:
        coarse: A.
        fine: B.
        start: k_A.
        end: k_B, above k_A.

    Raises:
        ValueError: end is not above start.

    Source: Génevaux et al. 2015, section 6, doi:10.1111/cgf.12530.
    """
    if not start < end:
        raise ValueError(f"the level of detail must rise from start to end, not from {start:g} to {end:g}")
    return _checked(LevelOfDetail(coarse, fine, start, end))
