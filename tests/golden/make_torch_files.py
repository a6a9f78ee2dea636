"""Writes tiny.pth and tiny_legacy.pth: what PyTorch's own torch.save makes of a few tensors. Needs torch (CPU)."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import torch

FOLDER = Path(__file__).parent


def tensors() -> OrderedDict[str, torch.Tensor]:
    base = torch.arange(24, dtype=torch.float32)
    return OrderedDict(
        plain=base.reshape(2, 3, 4),
        turned=base.reshape(4, 6).t(),
        part=base[5:9],
        half=torch.tensor([0.5, -2.0], dtype=torch.float16),
        double=torch.tensor(1.25, dtype=torch.float64),
        parameter=torch.nn.Parameter(torch.ones(2, 2)),
        counter=torch.tensor(7),
        empty=torch.zeros(0, 3),
    )


if __name__ == "__main__":
    torch.save({"state_dict": tensors(), "epoch": 3, "lr": 0.1, "notes": ["a", None, True]}, FOLDER / "tiny.pth")
    torch.save(tensors(), FOLDER / "tiny_legacy.pth", _use_new_zipfile_serialization=False)
