"""The commands, one module each; a module is imported only when its command runs."""

from __future__ import annotations

COMMANDS: dict[str, str] = {
    "demo": "map the bundled sample with every labeller and show what comes out",
    "map": "map a stereo sequence",
    "train": "train or fine-tune DeepLabv3+ on images and masks",
    "refine": "refine poses, camera mounting and stereo calibration until frames agree",
    "evaluate": "score a map against an orthomosaic labelled from above",
    "tune": "tune the numbers of fusion against ground truth",
    "segment": "label images with a network, and score the labels",
    "simulate": "render a traverse, or training images, of a simulated world",
    "weights": "convert or download pretrained networks",
    "export": "write a map in another form",
    "report": "write the HTML report of a run anew",
    "info": "show versions, devices and folders",
}
"""Name and one-line help of each command, in the order of `jaxmap --help`."""
