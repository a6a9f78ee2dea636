"""Compares the networks' logits with torch's, at full sizes: greatest difference, and pixels of the same class.

    python tests/golden/make_smp_golden.py --large DIR    # needs torch: its logits, of seeded weights and images
    python scripts/fidelity.py DIR

The tests do the same at small sizes, from a golden file.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

from jaxmap.models.deeplab import inference_network
from jaxmap.models.importers import import_weights

TESTS = Path(__file__).resolve().parents[1] / "tests"


def main() -> None:
    """Prints a line for each network, stride and size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logits", type=Path)
    given = parser.parse_args()
    sys.path[:0] = [str(TESTS)]
    from golden.seeded_weights import seeded_image
    from models.test_golden_logits import seeded_checkpoint

    print(f"{'network':14s}{'stride':>7s}{'size':>10s}{'greatest difference':>21s}{'same class':>12s}")
    for path in sorted(given.logits.glob("*.npy")):
        match = re.fullmatch(r"(\w+)_(\d+)_(\d+)x(\d+)", path.stem)
        if match is None:
            raise SystemExit(f"error: {path} is not named BACKBONE_STRIDE_HEIGHTxWIDTH.npy")
        backbone, (stride, height, width) = match[1], map(int, match.groups()[1:])
        with tempfile.TemporaryDirectory() as folder:
            checkpoint = seeded_checkpoint(backbone, Path(folder) / "smp.safetensors")
            imported = import_weights(checkpoint, output_stride=stride)
        network = inference_network(imported.architecture, imported.weights)
        logits = np.asarray(jax.jit(network.apply)(network.weights, seeded_image(height, width)[None])[0])
        expected = np.load(path, allow_pickle=False)
        same = (logits.argmax(-1) == expected.argmax(-1)).mean()
        error = np.abs(logits - expected).max()
        print(f"{backbone:14s}{stride:7d}{f'{height}x{width}':>10s}{error:21.2e}{same:12.3%}", flush=True)


if __name__ == "__main__":
    main()
