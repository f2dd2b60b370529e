"""Finds the views that show an object unoccluded, by rendering the whole scanned mesh."""

import numpy as np

from data_prep.readers.scannet.scans import Scan
from sceneprior.render.zbuffer import NEAR_PLANE_M, rasterize

_BEHIND_M = 0.05
"""Minimum depth of a vertex behind the rendered surface to count as occluded; smaller depths occur
at borders between objects."""
_CUT_SHARE = 0.005
"""Tolerance of the sides of the 2D box, relative to the image's longer side."""


def unoccluded(scan: Scan, chosen: np.ndarray) -> np.ndarray:
    """Find the views that show each chosen instance without occlusion, (views, len(chosen)) bool.

    The 2D box of its visible vertices is compared with the 2D box of all its vertices. Everything
    in the scan's mesh occludes: walls, doors, objects, unannotated surfaces. Indices from
    `len(scan.instances)` on are never unoccluded.
    """
    mesh, (height, width) = scan.mesh, scan.settings.image_size
    K = scan.intrinsics
    projection = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    slack = _CUT_SHARE * max(height, width)
    whole = np.zeros((len(scan.frames), len(chosen)), dtype=bool)
    owner = np.full(len(mesh.vertices_m) + 1, -1)
    for k, item in enumerate(scan.instances):
        owner[item.vertices] = k
    # The last row is for pixels that show no surface.
    owners = np.concatenate([owner[mesh.faces], [[-1, -1, -1]]])
    points = [mesh.vertices_m[item.vertices] for item in scan.instances]
    for view, camera in enumerate(scan.world_to_camera):
        index, nearest = rasterize(mesh.vertices_m, mesh.faces, camera, projection, (height, width))
        for column, k in enumerate(chosen):
            if k >= len(scan.instances):
                continue
            x, y, depth = (points[k] @ camera[:3, :3].T + camera[:3, 3]).T
            if (depth <= NEAR_PLANE_M).any():
                continue
            pixels = np.stack([K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]])
            columns, rows = np.floor(np.clip(pixels, -1, max(height, width))).astype(np.int64)
            seen = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
            at = rows[seen], columns[seen]
            hidden = (nearest[at] < depth[seen] - _BEHIND_M) & (owners[index[at]] != k).all(axis=1)
            seen[seen] = ~hidden
            if seen.any():
                ends = [np.stack([ends.min(axis=1), ends.max(axis=1)])
                        for ends in (pixels, pixels[:, seen])]  # fmt: skip
                whole[view, column] = np.abs(ends[0] - ends[1]).max() <= slack
    return whole
