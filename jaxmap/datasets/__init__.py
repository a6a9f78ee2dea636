"""Readers of stereo sequences: `open_sequence` opens a folder or a bundled sample.

The names are listed in `__init__.pyi`; each is imported when it is first used, so that `ReadOptions` comes without JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
