"""Host side of stereo: rectification and matching by OpenCV."""
