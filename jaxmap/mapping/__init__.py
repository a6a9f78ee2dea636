"""The compiled step, what feeds it frames, and the map on disk."""
