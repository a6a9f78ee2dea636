"""A kernel in C++ for what XLA leaves slow on a CPU, compiled on the user's machine where it has a compiler."""
