"""Bundled sequences, opened as `sample:NAME`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import skimage
from jaxtyping import Float32

from jaxmap.datasets.base import FrameRef, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.katwijk import open_katwijk
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import make_pose_track
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.files import bundled
from jaxmap.types import make_stereo_camera


def open_sample(name: str, options: ReadOptions) -> StereoSequence:
    """Opens a bundled sequence.

    Raises:
        JaxmapError: there is none of that name.
        UsageError: the options name a reader of folders.
    """
    if name not in SAMPLES:
        raise JaxmapError(f"there is no sample {name!r}", fix=f"choose {', '.join(SAMPLES)}")
    if options.dataset != "auto":
        raise UsageError(f"a sample is not read as {options.dataset}", where="--dataset", fix="leave the option out")
    return SAMPLES[name](options)


def motorcycle_disparity() -> Float32[np.ndarray, "500 741"]:
    """The true disparity of the Motorcycle pair in pixels of its left image, NaN where unknown.

    Raises:
        JaxmapError: scikit-image does not carry the file.
    """
    with np.load(_motorcycle_file("motorcycle_disp.npz"), allow_pickle=False) as content:
        disparity_px = content["arr_0"].astype(np.float32)
    disparity_px[~np.isfinite(disparity_px)] = np.nan
    return disparity_px


def _open_motorcycle(options: ReadOptions) -> StereoSequence:
    """One pair of the Middlebury 2014 benchmark, as scikit-image ships it (a quarter of its size)."""
    camera = make_stereo_camera(
        fx_px=994.978,
        cx_px=311.193,
        cy_px=254.877,
        baseline_m=0.193001,
        doffs_px=31.086,
        width_px=741,
        height_px=500,
    )
    left, right = (_motorcycle_file(f"motorcycle_{side}.png") for side in ("left", "right"))
    return assemble(
        name="motorcycle",
        dataset="sample",
        where="sample:motorcycle",
        frames=[FrameRef(left.stem, 0.0, left, right)],
        track=read_pose_track(options, options.poses)
        if options.poses
        else make_pose_track(np.zeros(1), np.eye(4)[None]),
        camera=read_camera_yaml(options.calibration) if options.calibration else camera,
        options=options,
        true_disparity=lambda frame: motorcycle_disparity(),
    )


def _motorcycle_file(name: str) -> Path:
    # Not through skimage.data, which would try to download a missing file.
    path = Path(skimage.__file__).parent / "data" / name
    if not path.is_file():
        raise JaxmapError("the Motorcycle sample is missing", where=path, fix="reinstall scikit-image from its wheel")
    return path


def sample_truth() -> Path:
    """The ground truth of `sample:traverse`: labels, orthomosaic, heights and poses."""
    return bundled("traverse/gt")


def _open_traverse(options: ReadOptions) -> StereoSequence:
    """A drive through a simulated world in the Katwijk layout (`scripts/make_bundled.py`); poses are estimated."""
    sequence = open_katwijk(bundled("traverse/Part1"), options)
    return replace(sequence, name="traverse")


SAMPLES: dict[str, Callable[[ReadOptions], StereoSequence]] = {
    "motorcycle": _open_motorcycle,
    "traverse": _open_traverse,
}
"""The openers of the bundled sequences, by name."""
