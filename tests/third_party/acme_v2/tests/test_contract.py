"""Every node keeps the contract."""

from __future__ import annotations

import numpy as np
from acme_sound.porttypes import Melody, Wave

from nodegraph.testing import Example, parametrize_with_checks

TUNE = Melody(np.array([60, 64, 67]), np.array([0.5, 0.25, 1.0]))
NOISE = Wave(np.random.default_rng(1).uniform(-1, 1, 100).astype(np.float32), 8000.0)
EXAMPLES = {
    "acme.scale": [Example(), Example({}, {"notes": 12})],
    "acme.shift": [Example({"melody": TUNE}, {"interval": -3})],
    "acme.as_wave": [Example({"melody": TUNE})],
    "acme.loudness": [Example({"wave": NOISE})],
    "acme.write_tune": [Example({"melody": TUNE}, {"name": "a/b.txt"})],
}


@parametrize_with_checks("acme", EXAMPLES)
def test_contract(check):
    check()
