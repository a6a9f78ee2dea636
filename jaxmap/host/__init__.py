"""Files, threads, caches and memory of the host."""
