"""Pure, jitted geometry: camera, voxel grid, plane fitting."""
