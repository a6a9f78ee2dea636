"""A simulator of rover traverses: worlds drawn from a seed, path-traced, written in the Katwijk layout."""
