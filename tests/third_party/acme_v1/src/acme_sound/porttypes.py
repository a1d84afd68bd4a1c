"""What travels on wires: melodies, and sound as samples."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import port_type


@port_type
class Melody:
    """Notes one after the other.

    Attributes:
        pitches: MIDI note numbers, (n,) int64; 69 is the a of 440 Hz.
        seconds: how long each lasts, (n,) float64.
    """

    pitches: npt.NDArray[np.int64]
    seconds: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.pitches.shape != self.seconds.shape or self.pitches.ndim != 1:
            raise ValueError("a melody needs one length for each pitch")


@port_type
class Wave:
    """Sound pressure over time, -1 to 1.

    Attributes:
        samples: (n,) float32.
        rate: samples per second, Hz.
    """

    samples: npt.NDArray[np.float32]
    rate: float
