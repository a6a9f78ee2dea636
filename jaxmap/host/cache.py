"""The cache folder, where compiled programs are kept between runs."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """`$JAXMAP_CACHE`, else `jaxmap` in the user's cache folder."""
    if own := os.environ.get("JAXMAP_CACHE"):
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxmap"


def keep_compiled_programs(*, scopes: bool = False) -> None:
    """Turns on JAX's persistent compilation cache, so that a second run of the same kind starts at once.

    Args:
        scopes: use a kept program only if the names of its stages match too, which a profile needs.
    """
    import jax

    folder = cache_folder() / "compiled"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # Without the folder, programs are compiled in every run.
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_include_metadata_in_key", scopes)
    # Small programs too: a start has dozens of them, and compiling one takes as long as loading a large one.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
