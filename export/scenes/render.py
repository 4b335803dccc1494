"""Exact cone-beam path lengths through a union of capsules, and its occupancy of voxels.

For every pixel each capsule that its ray meets gives one interval; the union of the intervals
is the path length. Nothing is voxelised, so any resolution costs what its vessel pixels cost.
"""

from __future__ import annotations

import numba
import numpy as np

from gcar_deploy.geometry.carm import CArm


@numba.njit(cache=True)
def _capsule_interval(ox, oy, oz, dx, dy, dz, a, b, r):  # type: ignore[no-untyped-def]
    """Return entry and exit (entry > exit: none) of a unit ray and the capsule (a, b, r)."""
    t_in, t_out = 1e30, -1e30
    for k in range(2):
        e = a if k == 0 else b
        px, py, pz = ox - e[0], oy - e[1], oz - e[2]
        half = px * dx + py * dy + pz * dz
        # Distance from the ray, not a difference of squares of large numbers.
        qx, qy, qz = px - half * dx, py - half * dy, pz - half * dz
        gap = r * r - (qx * qx + qy * qy + qz * qz)
        if gap > 0:
            root = np.sqrt(gap)
            t_in = min(t_in, -half - root)
            t_out = max(t_out, -half + root)
    ax, ay, az = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = np.sqrt(ax * ax + ay * ay + az * az)
    if length < 1e-9:
        return t_in, t_out
    ax, ay, az = ax / length, ay / length, az / length
    along = dx * ax + dy * ay + dz * az
    ex, ey, ez = dx - along * ax, dy - along * ay, dz - along * az
    A = ex * ex + ey * ey + ez * ez
    if A > 1e-9:
        px, py, pz = ox - a[0], oy - a[1], oz - a[2]
        # Shift the origin to the point nearest to the capsule: small numbers from here on.
        shift = -(px * dx + py * dy + pz * dz)
        px, py, pz = px + shift * dx, py + shift * dy, pz + shift * dz
        p_along = px * ax + py * ay + pz * az
        fx, fy, fz = px - p_along * ax, py - p_along * ay, pz - p_along * az
        B = ex * fx + ey * fy + ez * fz
        C = fx * fx + fy * fy + fz * fz - r * r
        gap = B * B - A * C
        if gap > 0:
            root = np.sqrt(gap)
            t0, t1 = (-B - root) / A, (-B + root) / A
            # Clip to the slab between the two ends.
            if abs(along) > 1e-12:
                s0, s1 = -p_along / along, (length - p_along) / along
                if s0 > s1:
                    s0, s1 = s1, s0
                t0, t1 = max(t0, s0), min(t1, s1)
            elif p_along < 0 or p_along > length:
                t1 = t0 - 1
            if t0 < t1:
                t_in = min(t_in, t0 + shift)
                t_out = max(t_out, t1 + shift)
    return t_in, t_out


@numba.njit(cache=True)
def _collect(a, b, r, boxes, source, inverse, cols, fill, pixel, t0, t1):  # type: ignore[no-untyped-def]
    n = 0
    for i in range(len(r)):
        for row in range(boxes[i, 2], boxes[i, 3] + 1):
            for col in range(boxes[i, 0], boxes[i, 1] + 1):
                x = inverse[0, 0] * col + inverse[0, 1] * row + inverse[0, 2]
                y = inverse[1, 0] * col + inverse[1, 1] * row + inverse[1, 2]
                z = inverse[2, 0] * col + inverse[2, 1] * row + inverse[2, 2]
                norm = np.sqrt(x * x + y * y + z * z)
                low, high = _capsule_interval(
                    source[0], source[1], source[2], x / norm, y / norm, z / norm, a[i], b[i], r[i]
                )
                if low < high:
                    if fill:
                        pixel[n] = row * cols + col
                        t0[n] = low
                        t1[n] = high
                    n += 1
    return n


@numba.njit(cache=True)
def _union(order, pixel, t0, t1, image):  # type: ignore[no-untyped-def]
    current, end = -1, 0.0
    for k in range(len(order)):
        i = order[k]
        if pixel[i] != current:
            current, end = pixel[i], -1e30
        start = max(t0[i], end)
        if t1[i] > start:
            image[current] += t1[i] - start
            end = t1[i]


@numba.njit(cache=True)
def _longest(order, pixel, t0, t1, image, middle):  # type: ignore[no-untyped-def]
    """Sum stretches into ``image`` and put the middle of the longest one into ``middle``."""
    current, start, end, best = -1, 0.0, -1e30, 0.0
    for k in range(len(order) + 1):
        i = order[k] if k < len(order) else -1
        if i >= 0 and pixel[i] == current and t0[i] <= end:
            end = max(end, t1[i])
            continue
        if current >= 0:
            image[current] += end - start
            if end - start > best:
                best, middle[current] = end - start, 0.5 * (start + end)
        if i < 0:
            break
        if pixel[i] != current:
            current, best = pixel[i], 0.0
        start, end = t0[i], t1[i]


def path_lengths(carm: CArm, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Path length through the union of capsules at each pixel centre.

    Parameters
    ----------
    starts, ends : (n, 3) mm LPS
    radii : (n,) mm

    Returns
    -------
    (rows, columns) float32, mm
    """
    pixel, t0, t1 = _intervals(carm, starts, ends, radii)
    image = np.zeros(carm.rows * carm.columns)
    _union(np.lexsort((t0, pixel)), pixel, t0, t1, image)
    return image.reshape(carm.rows, carm.columns).astype(np.float32)


def path_and_depth(
    carm: CArm, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Path length and depth along the true ray of each pixel centre.

    Takes what ``path_lengths`` takes.

    Returns
    -------
    path : (rows, columns) float32, mm
    depth : (rows, columns) float64
        Distance from the source, along the ray, of the middle of the longest unbroken stretch
        of vessel, mm; NaN where there is none.
    """
    pixel, t0, t1 = _intervals(carm, starts, ends, radii)
    image = np.zeros(carm.rows * carm.columns)
    middle = np.full(carm.rows * carm.columns, np.nan)
    _longest(np.lexsort((t0, pixel)), pixel, t0, t1, image, middle)
    shape = (carm.rows, carm.columns)
    return image.reshape(shape).astype(np.float32), middle.reshape(shape)


def _intervals(
    carm: CArm, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel, entry and exit (mm from the source) of every meeting of a ray and a capsule."""
    boxes = _boxes(carm, starts, ends, radii)
    inside = (boxes[:, 0] <= boxes[:, 1]) & (boxes[:, 2] <= boxes[:, 3])
    a, b, r, boxes = starts[inside], ends[inside], radii[inside], boxes[inside]
    empty_i, empty_f = np.empty(0, np.int64), np.empty(0)
    if not len(r):
        return empty_i, empty_f, empty_f
    source, inverse = carm.source_mm, np.linalg.inv(carm.world2pixel[:, :3])
    args = (a, b, r, boxes, source, inverse, carm.columns)
    n = _collect(*args, False, empty_i, empty_f, empty_f)
    pixel, t0, t1 = np.empty(n, np.int64), np.empty(n), np.empty(n)
    _collect(*args, True, pixel, t0, t1)
    return pixel, t0, t1


def _boxes(carm: CArm, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray) -> np.ndarray:
    (pa, za), (pb, zb) = carm.project(starts), carm.project(ends)
    reach = radii * max(carm.focal_px) / np.maximum(np.minimum(za, zb) - radii, 1.0) * 1.05 + 1
    low = np.ceil(np.minimum(pa, pb) - reach[:, None])
    high = np.floor(np.maximum(pa, pb) + reach[:, None])
    return np.stack(
        [
            np.clip(low[:, 0], 0, carm.columns),
            np.clip(high[:, 0], -1, carm.columns - 1),
            np.clip(low[:, 1], 0, carm.rows),
            np.clip(high[:, 1], -1, carm.rows - 1),
        ],
        axis=1,
    ).astype(np.int64)


@numba.njit(cache=True)
def _occupancy(points, half, sub, a, b, r, head, items, low, cell, dims, out, off, rad, reach):  # type: ignore[no-untyped-def]
    offsets = (np.arange(sub) + 0.5) / sub * 2 - 1
    for i in range(len(points)):
        p = points[i]
        cx = int((p[0] - low[0]) / cell)
        cy = int((p[1] - low[1]) / cell)
        cz = int((p[2] - low[2]) / cell)
        best = 1e30
        hit = 0
        if cx < 0 or cy < 0 or cz < 0 or cx >= dims[0] or cy >= dims[1] or cz >= dims[2]:
            continue
        c = (cx * dims[1] + cy) * dims[2] + cz
        covered = np.zeros(sub * sub * sub, np.bool_)
        for k in range(head[c], head[c + 1]):
            j = items[k]
            ux, uy, uz = b[j, 0] - a[j, 0], b[j, 1] - a[j, 1], b[j, 2] - a[j, 2]
            uu = ux * ux + uy * uy + uz * uz + 1e-12
            wx, wy, wz = p[0] - a[j, 0], p[1] - a[j, 1], p[2] - a[j, 2]
            t = min(1.0, max(0.0, (wx * ux + wy * uy + wz * uz) / uu))
            ex, ey, ez = wx - t * ux, wy - t * uy, wz - t * uz
            dist = np.sqrt(ex * ex + ey * ey + ez * ez)
            if dist < best:
                best = dist
                off[i, 0], off[i, 1], off[i, 2] = -ex, -ey, -ez
                rad[i] = r[j]
            if dist < r[j] - 1.7321 * half:
                covered[:] = True
                hit = 1
            elif dist < r[j] + 1.7321 * half:
                q = 0
                for x in range(sub):
                    for y in range(sub):
                        for z in range(sub):
                            if not covered[q]:
                                vx = wx + half * offsets[x]
                                vy = wy + half * offsets[y]
                                vz = wz + half * offsets[z]
                                s = min(1.0, max(0.0, (vx * ux + vy * uy + vz * uz) / uu))
                                gx, gy, gz = vx - s * ux, vy - s * uy, vz - s * uz
                                if gx * gx + gy * gy + gz * gz < r[j] * r[j]:
                                    covered[q] = True
                            q += 1
                hit = 1
        if hit:
            out[i] = covered.sum() / covered.size
        if best > reach:
            rad[i] = np.nan


def occupancy(
    points: np.ndarray, voxel_mm: float, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray,
    *, sub: int = 4, reach_mm: float = 4.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Area-averaged occupancy of voxels, and where the centreline lies.

    Parameters
    ----------
    points : (n, 3) voxel centres, mm LPS
    voxel_mm : float edge of the cubic voxels, mm
    starts, ends, radii : capsules, mm
    reach_mm : float
        Beyond this distance offset and radius are NaN.

    Returns
    -------
    occupancy : (n,) 0 .. 1
    offset_mm : (n, 3) from the voxel centre to the nearest centreline point
    radius_mm : (n,) of that point
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    cell = 6.0
    margin = reach_mm + float(radii.max()) + voxel_mm
    low = np.minimum(starts, ends).min(axis=0) - margin
    high = np.maximum(starts, ends).max(axis=0) + margin
    dims = np.maximum(((high - low) / cell).astype(np.int64) + 1, 1)
    head, items = _bucket(starts, ends, np.full(len(radii), margin), low, cell, dims)
    out, off = np.zeros(len(points)), np.full((len(points), 3), np.nan)
    rad = np.full(len(points), np.nan)
    _occupancy(
        points,
        voxel_mm / 2,
        sub,
        starts,
        ends,
        radii,
        head,
        items,
        low,
        cell,
        dims,
        out,
        off,
        rad,
        reach_mm,
    )
    off[np.isnan(rad)] = np.nan
    return out, off, rad


@numba.njit(cache=True)
def _bucket(a, b, reach, low, cell, dims):  # type: ignore[no-untyped-def]
    n_cells = dims[0] * dims[1] * dims[2]
    head = np.zeros(n_cells + 1, np.int64)
    items = np.empty(0, np.int64)
    for fill in range(2):
        if fill:
            total = 0
            for c in range(n_cells):
                count = head[c]
                head[c] = total
                total += count
            head[n_cells] = total
            items = np.empty(total, np.int64)
            cursor = head.copy()
        for i in range(len(a)):
            lo = np.empty(3, np.int64)
            hi = np.empty(3, np.int64)
            for k in range(3):
                lo[k] = max(0, int((min(a[i, k], b[i, k]) - reach[i] - low[k]) / cell))
                hi[k] = min(dims[k] - 1, int((max(a[i, k], b[i, k]) + reach[i] - low[k]) / cell))
            for x in range(lo[0], hi[0] + 1):
                for y in range(lo[1], hi[1] + 1):
                    for z in range(lo[2], hi[2] + 1):
                        c = (x * dims[1] + y) * dims[2] + z
                        if fill:
                            items[cursor[c]] = i
                            cursor[c] += 1
                        else:
                            head[c] += 1
    return head, items
