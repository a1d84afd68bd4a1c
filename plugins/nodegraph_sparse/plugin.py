"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence

from nodegraph import Family, Preview, hookimpl

NODE_MODULES: tuple[str, ...] = (
    "patches",
    "dictionary_from_patches",
    "exemplar",
    "noise_dictionary",
    "merge_dictionaries",
    "multiresolution",
    "draw_dictionary",
    "omp",
    "sparse_terrain",
    "ksvd",
    "constrained_ksvd",
    "sparse_statistics",
    "rate_distortion",
    "save_statistics",
    "save_sparse",
    "load_sparse",
)


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``sparse``."""
    modules = tuple(f"nodegraph_sparse.{name}" for name in NODE_MODULES)
    return [Family("sparse", modules=modules, title="Sparse construction trees")]


@hookimpl
def nodegraph_previews() -> Sequence[Preview]:
    """List how patches, dictionaries and codes are drawn."""
    from nodegraph_sparse.previews import PREVIEWS

    return PREVIEWS
