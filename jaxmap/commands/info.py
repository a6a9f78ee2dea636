"""`jaxmap info`: versions, devices, folders."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass

from jaxmap.commands.console import parse


@dataclass(frozen=True)
class InfoArguments:
    """Show versions, devices and folders, for a report of a fault."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    parse(InfoArguments, "info", words)

    import cv2
    import flax
    import jax
    import numpy
    import zarr

    import jaxmap
    from jaxmap.datasets import READERS
    from jaxmap.host.cache import cache_folder
    from jaxmap.host.files import config_folder

    lines = {
        "jaxmap": jaxmap.__version__,
        "python": f"{platform.python_version()} on {platform.platform()}",
        "jax": f"{jax.__version__}, flax {flax.__version__}, numpy {numpy.__version__}",
        "opencv": f"{cv2.__version__}, {cv2.getNumThreads()} threads",
        "zarr": zarr.__version__,
        "devices": ", ".join(f"{device.platform}:{device.id} ({device.device_kind})" for device in jax.devices()),
        "cache": cache_folder(),
        "configs": f"{config_folder()}: {', '.join(sorted(file.stem for file in config_folder().glob('*.yaml')))}",
        "readers": ", ".join(f"{reader.name} ({reader.help})" for reader in READERS.values()),
    }
    width = max(map(len, lines))
    print("\n".join(f"{name:<{width}}  {value}" for name, value in lines.items()))
    return 0
