"""Segmentation networks: DeepLabv3 and DeepLabv3+ in Flax NNX, and their files."""
