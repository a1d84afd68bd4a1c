"""Writing a file whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from pathlib import Path

_FORGOTTEN_SECONDS = 3600


def write_atomically(target: Path, content: bytes | memoryview) -> None:
    """Write a file beside its place, then rename it into it: a reader sees all of the old one or all of the new one.

    What a killed writer of the same file left behind an hour ago or more is removed.

    Raises:
        OSError: the file cannot be written; what stood there before is whole.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    prefix = f".{target.name[:40]}."
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=prefix, suffix=".part")
    aside = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        aside.chmod(target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask())
        aside.replace(target)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    for left in target.parent.iterdir():
        if left.name.startswith(prefix) and left.suffix == ".part":
            with contextlib.suppress(OSError):
                if left.stat().st_mtime < time.time() - _FORGOTTEN_SECONDS:
                    left.unlink()


def _umask() -> int:
    # The mask can only be read by setting it; the safe value is there for an instant at most.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
