"""The nodes of the family ``acme``."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from acme_sound.porttypes import Melody, Wave
from nodegraph import File, OutputName, Param, node

_MAJOR = (0, 2, 4, 5, 7, 9, 11)
_RATE = 8000.0


@node(version=1)
def scale(
    *,
    root: Annotated[int, Param("The lowest note, as a MIDI number.", ge=0, le=127)] = 60,
    notes: Annotated[int, Param("How many notes.", ge=1, le=50)] = 8,
    tempo: Annotated[float, Param("Notes per minute.", gt=0)] = 120.0,
) -> Melody:
    """Give a major scale upwards."""
    steps = np.arange(notes)
    pitches = root + 12 * (steps // 7) + np.asarray(_MAJOR)[steps % 7]
    return Melody(pitches, np.full(notes, 60.0 / tempo))


@node(version=1)
def transpose(melody: Melody, *, semitones: Annotated[int, Param("How far upwards.", ge=-60, le=60)] = 0) -> Melody:
    """Move a melody up or down."""
    return Melody(melody.pitches + semitones, melody.seconds)


@node(version=1)
def as_wave(melody: Melody) -> Wave:
    """Play a melody with plain sine tones."""
    tones = [
        np.sin(2 * np.pi * 440 * 2 ** ((pitch - 69) / 12) * np.arange(int(seconds * _RATE)) / _RATE)
        for pitch, seconds in zip(melody.pitches, melody.seconds, strict=True)
    ]
    return Wave(np.concatenate(tones).astype(np.float32), _RATE)


@node(version=1)
def loudness(wave: Wave) -> float:
    """Give the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(wave.samples, dtype=np.float64))))


@node(version=1)
def write_tune(
    melody: Melody, *, name: Annotated[OutputName, Param("Name of the file to write.")] = "tune.txt"
) -> File:
    """Write one line for each note: pitch and seconds."""
    notes = zip(melody.pitches.tolist(), melody.seconds.tolist(), strict=True)
    lines = [f"{pitch} {seconds!r}\n" for pitch, seconds in notes]
    return File.of(name, "".join(lines).encode())
