"""Numba kernel of the software renderer: the nearest triangle at each pixel (z-buffer)."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS_2D, array_of

_triangles = array_of(types.int32, 2)

#: Tolerance in pixels within which a pixel centre lies on an edge and is drawn, so that adjacent triangles leave no gap.
ON_EDGE = 1e-9


@njit(
    types.void(
        FLOATS_2D, _triangles, types.int32, types.int64, types.int64, types.float64[:, ::1], types.int32[:, ::1]
    ),
)
def draw_triangles(screen, triangles, first_id, first_row, end_row, nearness, ids):
    """
    Draw the triangles that face the viewer into a band of rows.

    ``screen`` (n_point, 3) is the position in pixels, x to the right and y **down**, and the inverse depth: one over the
    distance from the plane of the viewer, which unlike the distance is linear on the screen. ``nearness`` and ``ids``
    (n_y, n_x) contain the largest inverse depth so far and its triangle; triangle i writes ``first_id + i``. Triangles that
    extend behind the viewer (inverse depth <= 0) are skipped.
    """
    n_x = ids.shape[1]
    for i in range(triangles.shape[0]):
        a, b, c = triangles[i, 0], triangles[i, 1], triangles[i, 2]
        ay, by, cy = screen[a, 1], screen[b, 1], screen[c, 1]
        # Rows whose centres lie between the lowest and the highest corner.
        top = max(first_row, int(np.ceil(min(ay, by, cy) - 0.5 - ON_EDGE)))
        bottom = min(end_row - 1, int(np.floor(max(ay, by, cy) - 0.5 + ON_EDGE)))
        if top > bottom:
            continue
        ax, bx, cx = screen[a, 0], screen[b, 0], screen[c, 0]
        # Counter-clockwise from outside is clockwise with y pointing down: other triangles are back faces.
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        az, bz, cz = screen[a, 2], screen[b, 2], screen[c, 2]
        if area >= 0.0 or min(az, bz, cz) <= 0.0:
            continue
        slope_x = ((bz - az) * (cy - ay) - (cz - az) * (by - ay)) / area
        slope_y = ((cz - az) * (bx - ax) - (bz - az) * (cx - ax)) / area
        for row in range(top, bottom + 1):
            y = row + 0.5
            left, right = -np.inf, np.inf
            for k in range(3):
                if k == 0:
                    px, py, qx, qy = ax, ay, bx, by
                elif k == 1:
                    px, py, qx, qy = bx, by, cx, cy
                else:
                    px, py, qx, qy = cx, cy, ax, ay
                if py == qy:
                    continue
                x = px + (y - py) * ((qx - px) / (qy - py))
                # The outline goes down on the triangle's left side and up on its right.
                if qy > py:
                    left = max(left, x)
                else:
                    right = min(right, x)
            start = max(0, int(np.ceil(max(left, -1.0) - 0.5 - ON_EDGE)))
            stop = min(n_x - 1, int(np.floor(min(right, n_x + 1.0) - 0.5 + ON_EDGE)))
            for column in range(start, stop + 1):
                near = az + slope_x * (column + 0.5 - ax) + slope_y * (y - ay)
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    ids[row, column] = first_id + i
