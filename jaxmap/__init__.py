"""Stereo images and rover poses in, a georeferenced 3D semantic voxel map out, in JAX.

The public names are listed in `__init__.pyi`; each is imported when it is first used, so that
`import jaxmap` costs nothing.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
