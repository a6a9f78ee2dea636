"""The options of the ensemble: how many members, and what each of them doubts."""

from __future__ import annotations

from typing import Annotated

from jaxmap.host.settings import NotNegative, Positive, count, options

Sigma = Annotated[float, NotNegative]


@options("ensemble")
class EnsembleOptions:
    """Members and their spread. A standard deviation of 0 turns its error off."""

    members: Annotated[int, count(1024, least=0)] = 0
    """Maps beside the map, each made with errors of its own; 0 makes none. Each takes as much memory as the occupancy
    and one class of the map."""
    position_sigma_m: Sigma = 0.02
    """Standard deviation of the camera's position, along each axis: RTK GPS is good for 0.01 to 0.03."""
    heading_sigma_rad: Sigma = 0.01
    """Standard deviation of the heading."""
    tilt_sigma_rad: Sigma = 0.005
    """Standard deviation of roll and pitch, each."""
    pose_correlation_s: Annotated[float, Positive] = 10.0
    """Time over which errors of the pose last: much longer than the drive, they are offsets; far below the time
    between frames, they are noise."""
    disparity_sigma_px: Sigma = 0.25
    """Standard deviation of the disparity."""
    disparity_block_px: Annotated[int, count(4096)] = 16
    """Edge of the blocks whose pixels share their error of disparity, as neighbours do that were matched together."""
    increment_sigma: Sigma = 0.3
    """Relative standard deviation (log-normal) of what each label, a hit and a miss add to the log-odds."""
    temperature_sigma: Sigma = 0.3
    """Relative standard deviation (log-normal) of the temperature of soft labels."""
    label_bias_sigma: Sigma = 1.0
    """Standard deviation of what is added to the logits of each class of soft labels, the same for the whole drive."""
    at_once: Annotated[int, count(1024)] = 1
    """Members computed together: faster on an accelerator, at the cost of memory. The result is the same."""
