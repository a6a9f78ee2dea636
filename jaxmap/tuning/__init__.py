"""Gradients of the score of a map, and what is tuned by them."""
