"""Maps in the forms that other programs read: point clouds and rasters."""
