"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nodegraph import Family, Format, Migration, Node, Preview, hookimpl


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``acme``."""
    return [Family("acme", modules=("acme_sound.nodes",), title="Acme sound")]


@hookimpl
def nodegraph_port_types() -> Sequence[type]:
    """List melodies and waves."""
    from acme_sound.porttypes import Melody, Wave

    return [Melody, Wave]


@hookimpl
def nodegraph_conversions() -> Sequence[Node[..., Any]]:
    """A melody may go wherever a wave is wanted."""
    from acme_sound.nodes import as_wave

    return [as_wave]


@hookimpl
def nodegraph_previews() -> Sequence[Preview]:
    """Draw a melody."""
    from acme_sound.porttypes import Melody
    from acme_sound.roll import draw

    return [Preview(Melody, draw)]


@hookimpl
def nodegraph_formats() -> Sequence[Format]:
    """Read songs as terrain, and write any raster as one."""
    from acme_sound import songs
    from nodegraph_terrain.raster import Raster

    return [Format(Raster, (".song",), "Song", songs.read, songs.write)]


@hookimpl
def nodegraph_migrations() -> Sequence[Migration]:
    """List what changed with 0.2: a node and a parameter got other names, and a tempo is a length now."""
    return [
        Migration("acme.transpose", 2, new_type="acme.shift", parameters={"semitones": "interval"}),
        Migration("acme.scale", 2, change=_tempo_in_seconds),
    ]


def _tempo_in_seconds(params: dict[str, Any]) -> dict[str, Any]:
    return {name: 60.0 / value if name == "tempo" else value for name, value in params.items()}
