"""The benchmarks behind `scripts/bench.py`: the harness, the cases, and the pages that show them."""
