"""Many maps of one drive, each under errors of its own: how sure the map is of what it says."""
