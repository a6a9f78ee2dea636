"""The rover's body: unseen by its own cameras, it casts its shadow into their view."""

from __future__ import annotations

import numpy as np

from jaxmap.simulation.backdrop import box_mesh
from jaxmap.simulation.camera_rig import CAMERA_HEIGHT_M, T_BODY_LEFT_POSITION_M
from jaxmap.simulation.drive import WHEEL_BASE_M, WHEEL_TRACK_M
from jaxmap.simulation.mesh import Mesh, join
from jaxmap.simulation.sensors import WHEEL_RADIUS_M


def rover_mesh() -> Mesh:
    """Box, deck, mast with a head, camera bar and six wheels, in the body frame (x backward, y right, z up).

    All of it lies behind the cameras, so that it may be left out of their pictures.
    """
    ground = T_BODY_LEFT_POSITION_M[2] - CAMERA_HEIGHT_M
    grey = (0.3, 0.3, 0.3)
    parts = [
        box_mesh((0.12, 0.0, ground + 0.5), (0.75, 0.5, 0.3), grey),
        box_mesh((0.15, 0.0, ground + 0.7), (0.9, 0.75, 0.04), grey),
        box_mesh((-0.25, 0.0, ground + 1.2), (0.08, 0.08, 1.0), grey),
        box_mesh((-0.25, 0.0, ground + 1.75), (0.14, 0.6, 0.16), grey),
        box_mesh((-0.3, -0.02, ground + 1.1), (0.06, 0.25, 0.07), grey),
        box_mesh((0.221, -0.052, ground + 1.6), (0.03, 0.03, 1.0), grey),
        *(
            _wheel(-ahead * WHEEL_BASE_M / 2 + 0.1, side * WHEEL_TRACK_M / 2, ground + WHEEL_RADIUS_M)
            for ahead in (-1, 0, 1)
            for side in (-1, 1)
        ),
    ]
    return join(parts)


def _wheel(x: float, y: float, z: float) -> Mesh:
    """Three boxes turned on each other make a wheel round enough for a shadow."""
    box = box_mesh((0.0, 0.0, 0.0), (1.9 * WHEEL_RADIUS_M, 0.12, 1.1 * WHEEL_RADIUS_M), (0.2, 0.2, 0.2))
    parts = []
    for angle in np.deg2rad([0, 60, 120]):
        R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        parts.append(box._replace(vertices_m=(box.vertices_m @ R.T + (x, y, z)).astype(np.float32)))
    return join(parts)
