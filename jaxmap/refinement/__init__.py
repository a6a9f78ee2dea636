"""Poses, camera mounting and stereo calibration, refined until the frames of a sequence agree."""
