"""D-infinity: flow in the direction of steepest descent over eight triangular facets, shared by two neighbours.

Reference: D. G. Tarboton (1997): A new method for the determination of flow directions and upslope areas in grid
digital elevation models. Water Resources Research 33(2). doi:10.1029/96WR03137.
"""

from __future__ import annotations

import numpy as np

from nodegraph_hydrology.flow import Floats, Flow, Index


def parts(flow: Flow) -> tuple[Index, Index, Floats]:
    """Return (source, target, share) of all flow between cells; the shares of a source sum to 1.

    On the facet of a straight neighbour e1 at distance d1 and the diagonal one e2 beyond it, d2 to the side, the slope
    is (s1, s2) = ((e0 - e1) / d1, (e1 - e2) / d2) and its direction r = atan(s2 / s1), held between 0 and
    atan(d2 / d1).  Of the steepest facet, e2 receives the part r / atan(d2 / d1), e1 the rest.  Cells of flats and
    breaches, and those that a void leaves without a facet as steep as D8's descent, flow to their D8 receiver.
    """
    lattice, height = flow.lattice, flow.height
    cells = np.flatnonzero(lattice.known & (flow.receiver >= 0))
    here = height[cells].astype(np.float64)
    best = np.zeros(len(cells))
    share = np.zeros(len(cells))
    first, second = flow.receiver[cells], flow.receiver[cells]
    free = ~flow.forced[cells]
    for straight in (0, 2, 4, 6):
        d1, d2 = lattice.cell if straight in (0, 4) else lattice.cell[::-1]
        limit = np.arctan2(d2, d1)
        e1 = height[cells + lattice.offsets[straight]].astype(np.float64)
        for diagonal in ((straight + 1) % 8, (straight - 1) % 8):
            e2 = height[cells + lattice.offsets[diagonal]].astype(np.float64)
            s1, s2 = (here - e1) / d1, (e1 - e2) / d2
            angle = np.arctan2(s2, s1)
            along = angle <= 0
            beyond = angle >= limit
            slope = np.where(along, s1, np.where(beyond, (here - e2) / np.hypot(d1, d2), np.hypot(s1, s2)))
            better = free & (slope > best)
            best[better] = slope[better]
            first[better] = (cells + lattice.offsets[straight])[better]
            second[better] = (cells + lattice.offsets[diagonal])[better]
            share[better] = np.where(along, 0.0, np.where(beyond, 1.0, angle / limit))[better]
    down = flow.receiver[cells]
    fall = here - height[down]
    row, column = np.divmod(np.abs(down - cells) + 1, lattice.shape[1] + 2)
    far = np.hypot(row * lattice.cell[1], (column - 1) * lattice.cell[0])
    lost = fall / far > best * (1 + 1e-6)
    first[lost], share[lost] = down[lost], 0.0
    source = np.concatenate([cells, cells])
    target, weight = np.concatenate([first, second]), np.concatenate([1 - share, share])
    kept = weight > 0
    return source[kept], target[kept], weight[kept]
