"""The cache folder: compiled programs are kept there from run to run."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """`$JAXMAP_CACHE`, else `jaxmap` in the user's cache folder."""
    if own := os.environ.get("JAXMAP_CACHE"):
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxmap"


def keep_compiled_programs(*, scopes: bool = False) -> None:
    """Lets JAX keep what it compiles, so that a second run of the same kind starts at once.

    Args:
        scopes: take a kept program only where the names of its stages are those of this code, too, as a profile needs
            them; otherwise names do not matter.
    """
    import jax

    folder = cache_folder() / "compiled"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # Without a place to keep them, programs are compiled anew each time.
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_include_metadata_in_key", scopes)
    # All of them: a start compiles dozens of small programs, too, and each costs as much as a large one is to load.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
