"""A melody as a piano roll."""

from __future__ import annotations

import io

from acme_sound.porttypes import Melody

_PIXELS_PER_SECOND, _PIXELS_PER_NOTE = 40, 4


def draw(melody: Melody) -> bytes:
    """Return a PNG picture: time to the right, pitch upwards."""
    from PIL import Image, ImageDraw

    low, high = int(melody.pitches.min()), int(melody.pitches.max())
    width = max(1, round(float(melody.seconds.sum()) * _PIXELS_PER_SECOND))
    picture = Image.new("L", (width, (high - low + 1) * _PIXELS_PER_NOTE), 255)
    pen, start = ImageDraw.Draw(picture), 0.0
    for pitch, seconds in zip(melody.pitches, melody.seconds, strict=True):
        top = (high - int(pitch)) * _PIXELS_PER_NOTE
        left, start = start, start + float(seconds) * _PIXELS_PER_SECOND
        pen.rectangle((left, top, max(left, start - 2), top + _PIXELS_PER_NOTE - 2), fill=0)
    target = io.BytesIO()
    picture.save(target, "PNG")
    return target.getvalue()
