"""Films as files: MP4, GIF, or a PNG for each frame."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nodegraph import Context, File, OutputFile, Param, node
from nodegraph_render.flight import Film

SAMPLED = 24
"""Frames that the palette of a GIF is made from."""
GIF_RATE = 50.0
"""Frames a second that a GIF can have: viewers take delays below 0.02 s for 0.1 s."""


@node(version=1)
def save_film(
    film: Film,
    *,
    name: Annotated[str, OutputFile(), Param("File to write; the suffix is the format: mp4, gif or png (many).")],
    quality: Annotated[
        int, Param("Constant rate factor of an MP4: 0 keeps everything, 18 looks it, 51 is worst.", ge=0, le=51)
    ] = 18,
    context: Context,
) -> File:
    """Write a film to a file, or its frames to many.

    - ``.mp4``: H.264 (x264, 4:2:0, BT.709), which every player shows; width and height must be even.
    - ``.gif``: 256 colours, one palette for all frames, so that nothing flickers, by median cut and k-means over frames
      throughout the film; errors are diffused (Floyd and Steinberg).  Repeats for ever if the film is closed.  Delays
      are hundredths of a second, rounded so that the whole is as long as it should be; 50 frames a second at most.
    - ``.png``: ``name_0000.png``, ``name_0001.png`` and so on, without loss.

    The same film gives the same bytes on every run of one version of the libraries.

    Args:
        film: what to write.
        name: see above.
        quality: see above; a step of 6 halves or doubles the size.
        context: the engine's.

    Raises:
        ValueError: the suffix is none of these, the size is odd or the frame rate too high for the format, or ffmpeg
            fails.
    """
    suffix = Path(name).suffix.lower()
    writers = {".mp4": _mp4, ".gif": _gif, ".png": _pngs}
    if suffix not in writers:
        raise ValueError(f"'{name}' names no film format; end it in .mp4, .gif or .png")
    return writers[suffix](film, name, quality, context)


def _mp4(film: Film, name: str, quality: int, context: Context) -> File:
    import imageio_ffmpeg

    rows, cols = film.frames[0].shape
    if rows % 2 or cols % 2:
        raise ValueError(f"an MP4 of {cols} x {rows} pixels is not possible; make width and height even")
    # A fixed number of threads: x264 gives other bytes with another one.
    options = ["-crf", str(quality), "-preset", "medium", "-threads", "4"]
    options += ["-vf", "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+full_chroma_int"]
    options += ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv"]
    options += ["-movflags", "+faststart", "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "film.mp4"
        writer = imageio_ffmpeg.write_frames(
            str(target),
            (cols, rows),
            fps=film.frame_rate,
            codec="libx264",
            quality=None,
            macro_block_size=1,
            ffmpeg_log_level="error",
            output_params=options,
        )
        try:
            writer.send(None)
            for number, frame in enumerate(film.frames):
                context.progress(number / len(film.frames))
                writer.send(_colours(frame.data))
        except OSError as error:
            raise ValueError(f"ffmpeg cannot write '{name}' ({str(error).splitlines()[0]})") from error
        finally:
            writer.close()
        if not target.is_file() or not target.stat().st_size:
            raise ValueError(f"ffmpeg wrote nothing to '{name}'; see what it says on the console")
        return File.of(name, target.read_bytes())


def _gif(film: Film, name: str, _: int, context: Context) -> File:
    from PIL import Image as Pillow

    if film.frame_rate > GIF_RATE:
        raise ValueError(f"a GIF shows {GIF_RATE:g} frames a second at most, not {film.frame_rate:g}; write an mp4")
    count = len(film.frames)
    chosen = sorted({count * part // SAMPLED for part in range(SAMPLED)})
    side = max(1, round((sum(film.frames[0].shape) / 2) / 256))
    seen = np.concatenate([_colours(film.frames[number].data)[::side, ::side] for number in chosen])
    palette = Pillow.fromarray(np.ascontiguousarray(seen)).quantize(256, Pillow.Quantize.MEDIANCUT, kmeans=1)
    frames = []
    for number, frame in enumerate(film.frames):
        context.progress(0.9 * number / count)
        found = Pillow.fromarray(_colours(frame.data))
        frames.append(found.quantize(palette=palette, dither=Pillow.Dither.FLOYDSTEINBERG))
    ends = np.round(100 * np.arange(count + 1) / film.frame_rate).astype(int)
    options: dict[str, Any] = {"loop": 0} if film.closed else {}
    made = io.BytesIO()
    frames[0].save(
        made,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=[int(delay) * 10 for delay in np.diff(ends)],
        **options,
    )
    return File.of(name, made.getvalue())


def _pngs(film: Film, name: str, _: int, context: Context) -> File:
    from PIL import Image as Pillow

    digits, stem = max(4, len(str(len(film.frames) - 1))), name[: -len(".png")]
    files = []
    for number, frame in enumerate(film.frames):
        context.progress(number / len(film.frames))
        made = io.BytesIO()
        Pillow.fromarray(frame.data).save(made, "PNG", compress_level=6)
        files.append(File.of(f"{stem}_{number:0{digits}}{name[len(stem) :]}", made.getvalue()))
    return File(files[0].name, files[0].content, tuple(files[1:]))


def _colours(data: np.ndarray) -> np.ndarray:
    """Return the colours of a frame, without transparency: films have none."""
    return np.ascontiguousarray(data[..., :3])
