"""Scores: how good disparity, depth and maps are."""
