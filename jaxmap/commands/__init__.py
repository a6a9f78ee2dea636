"""The commands, one module each; a module is imported only when its command runs."""

from __future__ import annotations

COMMANDS: dict[str, str] = {
    "demo": "map the bundled sample with every labeller and compare the scores",
    "check": "say what is wrong with a sequence before it is mapped",
    "perceive": "match and label every frame once, and keep what was seen",
    "map": "map a stereo sequence",
    "train": "train or fine-tune DeepLabv3+, FCN-8s, SegNet or U-Net on images and masks",
    "refine": "refine poses, camera mounting and stereo calibration until frames agree",
    "explain": "tell which frames and pixels made a cell of a map",
    "merge": "add the maps of several sessions",
    "evaluate": "score a map against a labelled orthomosaic",
    "tune": "tune the fusion parameters against ground truth",
    "plan": "plan a path over a map, clear of rocks and hazards",
    "segment": "label images with a network and score the labels",
    "simulate": "render a traverse, or training images, of a simulated world",
    "weights": "convert or download pretrained networks",
    "export": "write a map in another file format",
    "report": "write the HTML report of a run again",
    "view": "show a run in the viewer of rerun, frame by frame",
    "info": "print versions, devices and folders",
}
"""Name and one-line help of each command, in the order of `jaxmap --help`."""
