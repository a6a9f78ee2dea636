"""The forms that a map can be written in; names only, so that the help of the command is immediate."""

from __future__ import annotations

from typing import NamedTuple


class Format(NamedTuple):
    """One form of a map.

    Attributes:
        files: that it goes into, in the run's folder.
        writer: `module:function`, called as `function(source, *paths)`, see `export.source.Source`. It returns those of
            the paths that it has written, or None for all.
    """

    files: tuple[str, ...]
    writer: str


FORMATS: dict[str, Format] = {
    "ply": Format(("map.ply",), "jaxmap.export.ply:write_ply"),
    "geotiff": Format(("bev.tif",), "jaxmap.export.geotiff:write_geotiff"),
    "png": Format(("bev.png", "missed.png"), "jaxmap.report.overview:write_overview"),
    "cog": Format(("bev_cog.tif",), "jaxmap.export.geotiff:write_cog"),
    "mesh": Format(("surface.ply",), "jaxmap.export.mesh_files:write_mesh_ply"),
    "gltf": Format(("surface.glb",), "jaxmap.export.mesh_files:write_gltf"),
    "las": Format(("map.las",), "jaxmap.export.las:write_las"),
    "laz": Format(("map.laz",), "jaxmap.export.las:write_las"),
    "octomap": Format(("map.ot", "map.bt"), "jaxmap.export.octomap_trees:write_octomap"),
    "nav2": Format(("map.yaml", "map.pgm", "costs.yaml", "costs.png"), "jaxmap.export.nav2:write_nav2"),
    "grid-map": Format(("grid_map.mcap",), "jaxmap.export.grid_map:write_grid_map"),
    "mcap": Format(("run.mcap",), "jaxmap.export.foxglove:write_foxglove"),
    "lac": Format(("lac.npy",), "jaxmap.export.lunar_challenge:write_lunar_challenge"),
    "colmap": Format(("colmap",), "jaxmap.runs.colmap:export_colmap"),
}
"""All forms, by the names of `jaxmap export --format`."""

OF_EACH_RUN = ("ply", "geotiff", "png")
"""Those that a run leaves at its end."""
