"""From labelled points to voxel evidence, and back from voxels to answers."""
