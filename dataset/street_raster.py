"""The synthetic street's scan converter: convex polygons, painted in the order given, with a depth test.

Every polygon is planar and convex, lies in 3-D, and is either flat-coloured or carries a texture with an affine map.
For a pixel with ray ``d = ((x-cx)/fx, (y-cy)/fy, 1)`` and a plane ``n.X = c`` the inverse depth is ``n.d / c``, affine
in the pixel, and a texture coordinate is ``(g.d) / inverse_depth + g0`` (perspective-correct). Edges blend by the
distance of the pixel's centre to the edge. Textures are read trilinearly from a mip chain (Williams 1983) with up to
``_MAX_TAPS`` taps along the longer axis of the pixel's footprint (Heckbert 1989).
"""

from dataclasses import dataclass

import numba
import numpy as np

MAX_CORNERS = 12
NO_OWNER = 0
NO_TEXTURE = -1

_NEAR_M = 0.12
_MAX_TAPS = 3
_SEGMENT = 8
# A surface this much farther (relative) than what is painted still wins: decals lie on their host, painted after it.
_DEPTH_SLACK = 0.985


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Polygons:
    """Convex planar polygons in world coordinates, in painting order."""

    corners: np.ndarray
    """(N, MAX_CORNERS, 3) float32, metres; rows past ``corner_count`` are ignored."""
    corner_count: np.ndarray
    """(N,) int32, 3 to MAX_CORNERS."""
    colour: np.ndarray
    """(N, 3) float32, 0 to 255; a texture is multiplied by ``colour / 255``."""
    texture: np.ndarray
    """(N,) int32 index in the atlas, or NO_TEXTURE."""
    gradient: np.ndarray
    """(N, 2, 4) float32: u = g[:3].X + g[3] in texels of level 0, likewise v."""
    owner: np.ndarray
    """(N,) int32: who the pixels belong to; NO_OWNER for the static scene."""
    alpha: np.ndarray
    """(N,) float32: opacity; below 1 neither owner nor depth is written."""
    grow_px: np.ndarray
    """(N,) float32: edges are moved out by this much (0.5 closes the seams of a mesh, 0 is exact)."""
    fog: np.ndarray
    """(N,) float32: share of the haze that applies (0 for the sky)."""

    def __len__(self) -> int:
        return len(self.corners)

    def take(self, index: np.ndarray) -> "Polygons":
        """The polygons at ``index`` (integers or a mask), in that order."""
        return Polygons(**{name: getattr(self, name)[index] for name in Polygons.__slots__})


def join(parts: list[Polygons]) -> Polygons:
    """All polygons, one list after the other."""
    return Polygons(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in Polygons.__slots__})


def make_polygons(
    corners: list[np.ndarray] | np.ndarray,
    *,
    colour: np.ndarray | tuple[float, float, float] = (255.0, 255.0, 255.0),
    texture: np.ndarray | int = NO_TEXTURE,
    gradient: np.ndarray | None = None,
    owner: int = NO_OWNER,
    alpha: float = 1.0,
    grow_px: float = 0.0,
    fog: float = 1.0,
) -> Polygons:
    """Polygons from a list of (n, 3) corner arrays; every other argument is one value or one per polygon."""
    count = len(corners)
    padded = np.zeros((count, MAX_CORNERS, 3), np.float32)
    for row, polygon in zip(padded, corners, strict=True):
        row[: len(polygon)] = polygon
    return Polygons(
        corners=padded,
        corner_count=np.array([len(polygon) for polygon in corners], np.int32).reshape(count),
        colour=np.broadcast_to(np.asarray(colour, np.float32), (count, 3)).copy(),
        texture=np.broadcast_to(np.asarray(texture, np.int32), (count,)).copy(),
        gradient=np.broadcast_to(
            np.zeros((2, 4), np.float32) if gradient is None else np.asarray(gradient, np.float32), (count, 2, 4)
        ).copy(),
        owner=np.full(count, owner, np.int32),
        alpha=np.full(count, alpha, np.float32),
        grow_px=np.full(count, grow_px, np.float32),
        fog=np.full(count, fog, np.float32),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Atlas:
    """Mip chains of all textures in one array; sides are powers of two, so that coordinates wrap by masks."""

    texels: np.ndarray
    """(M, 3) uint8, RGB."""
    offset: np.ndarray
    """(T, LEVELS) int64: where a level starts."""
    log_width: np.ndarray
    """(T, LEVELS) int32: log2 of a level's width."""
    log_height: np.ndarray
    """(T, LEVELS) int32."""
    levels: np.ndarray
    """(T,) int32: how many levels a texture has."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Canvas:
    """What the scan converter paints on; all (H, W)."""

    rgb: np.ndarray
    """(H, W, 3) uint8."""
    inverse_depth: np.ndarray
    """(H, W) float32, 1/m; 0 is infinitely far."""
    owner: np.ndarray
    """(H, W) uint8."""


def blank_canvas(width: int, height: int, colour: tuple[float, float, float]) -> Canvas:
    """A canvas of one colour, infinitely far."""
    rgb = np.empty((height, width, 3), np.uint8)
    rgb[:] = np.asarray(colour, np.uint8)
    return Canvas(
        rgb=rgb, inverse_depth=np.zeros((height, width), np.float32), owner=np.zeros((height, width), np.uint8)
    )


def paint(
    canvas: Canvas, polygons: Polygons, *, world_to_cam: np.ndarray, camera: tuple[float, float, float, float],
    atlas: Atlas, haze: tuple[float, float, float], haze_m: float, rows: tuple[int, int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Paint polygons in order.

    Args:
        canvas: painted in place.
        polygons: in world coordinates.
        world_to_cam: (4, 4).
        camera: fx, fy, cx, cy in pixels.
        atlas: the textures.
        haze: colour that distance tends to.
        haze_m: distance at which half of the colour is haze.
        rows: paint only rows ``[start, end)`` of the picture.

    Returns:
        (256,) int64: pixels each owner covered when it was painted, before anything nearer was painted over it; and
        (256,) int64: how often something nearer was there already.
    """
    drawn, rejected = np.zeros(256, np.int64), np.zeros(256, np.int64)
    first, last = rows or (0, canvas.inverse_depth.shape[0])
    _paint(
        canvas.rgb, canvas.inverse_depth, canvas.owner, drawn, rejected, first, last,
        polygons.corners, polygons.corner_count, polygons.colour, polygons.texture, polygons.gradient,
        polygons.owner, polygons.alpha, polygons.grow_px, polygons.fog,
        world_to_cam.astype(np.float64), np.array(camera, np.float64),
        atlas.texels, atlas.offset, atlas.log_width, atlas.log_height, atlas.levels,
        np.array(haze, np.float32), np.float32(haze_m),
    )  # fmt: skip
    return drawn, rejected


@numba.njit(cache=True, inline="always")
def _texel(texels, start, log_width, mask_u, mask_v, u, v, weight, out):
    """Add ``weight`` times the bilinear sample at (u, v) of one level to ``out``."""
    fu = u - np.float32(0.5)
    fv = v - np.float32(0.5)
    floor_u = np.floor(fu)
    floor_v = np.floor(fv)
    au = fu - floor_u
    av = fv - floor_v
    u0 = np.int64(floor_u) & mask_u
    u1 = (u0 + 1) & mask_u
    v0 = np.int64(floor_v) & mask_v
    v1 = (v0 + 1) & mask_v
    a = start + (v0 << log_width)
    b = start + (v1 << log_width)
    one = np.float32(1.0)
    w00 = (one - au) * (one - av) * weight
    w01 = au * (one - av) * weight
    w10 = (one - au) * av * weight
    w11 = au * av * weight
    r = texels[a + u0, 0] * w00 + texels[a + u1, 0] * w01 + texels[b + u0, 0] * w10 + texels[b + u1, 0] * w11
    g = texels[a + u0, 1] * w00 + texels[a + u1, 1] * w01 + texels[b + u0, 1] * w10 + texels[b + u1, 1] * w11
    c = texels[a + u0, 2] * w00 + texels[a + u1, 2] * w01 + texels[b + u0, 2] * w10 + texels[b + u1, 2] * w11
    return out[0] + r, out[1] + g, out[2] + c


@numba.njit(cache=True)
def _clip_near(corners, count, rotation, out):
    """Corners into camera axes, cut at the near plane (Sutherland and Hodgman 1974); returns how many are left."""
    cam = np.empty((count, 3))
    for k in range(count):
        x, y, z = corners[k, 0], corners[k, 1], corners[k, 2]
        for a in range(3):
            cam[k, a] = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z + rotation[a, 3]
    left = 0
    for k in range(count):
        p, q = cam[k], cam[(k + 1) % count]
        if p[2] >= _NEAR_M:
            out[left] = p
            left += 1
        if (p[2] >= _NEAR_M) != (q[2] >= _NEAR_M):
            t = (_NEAR_M - p[2]) / (q[2] - p[2])
            for a in range(3):
                out[left, a] = p[a] + t * (q[a] - p[a])
            left += 1
    return left


@numba.njit(cache=True)
def _edges(cam, left, camera, edges, extent):
    """Inward edge lines (a, b, c) of unit normal in the picture, and the extent; returns False if there is no area."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    screen = np.empty((left, 2))
    extent[0], extent[1], extent[2], extent[3] = 1e9, 1e9, -1e9, -1e9
    for k in range(left):
        screen[k, 0] = fx * cam[k, 0] / cam[k, 2] + cx
        screen[k, 1] = fy * cam[k, 1] / cam[k, 2] + cy
        extent[0] = min(extent[0], screen[k, 0])
        extent[1] = min(extent[1], screen[k, 1])
        extent[2] = max(extent[2], screen[k, 0])
        extent[3] = max(extent[3], screen[k, 1])
    area = 0.0
    for k in range(left):
        m = (k + 1) % left
        area += screen[k, 0] * screen[m, 1] - screen[m, 0] * screen[k, 1]
    if abs(area) < 1e-6:
        return 0
    sign = 1.0 if area > 0 else -1.0
    used = 0
    for k in range(left):
        m = (k + 1) % left
        dx, dy = screen[m, 0] - screen[k, 0], screen[m, 1] - screen[k, 1]
        length = np.sqrt(dx * dx + dy * dy)
        if length < 1e-7:
            continue
        edges[used, 0] = -dy / length * sign
        edges[used, 1] = dx / length * sign
        edges[used, 2] = -(edges[used, 0] * screen[k, 0] + edges[used, 1] * screen[k, 1])
        used += 1
    return used


@numba.njit(cache=True)
def _inverse_depth_row(cam, left, camera, row):
    """1/z = row[0] x + row[1] y + row[2] over pixels, by Newell's normal; returns False for a plane seen edge on."""
    nx, ny, nz, mx, my, mz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(left):
        p, q = cam[k], cam[(k + 1) % left]
        nx += (p[1] - q[1]) * (p[2] + q[2])
        ny += (p[2] - q[2]) * (p[0] + q[0])
        nz += (p[0] - q[0]) * (p[1] + q[1])
        mx += p[0] / left
        my += p[1] / left
        mz += p[2] / left
    c = nx * mx + ny * my + nz * mz
    if abs(c) < 1e-12:
        return False
    row[0] = nx / c / camera[0]
    row[1] = ny / c / camera[1]
    row[2] = nz / c - row[0] * camera[2] - row[1] * camera[3]
    return True


@numba.njit(cache=True)
def _texture_rows(gradient, rotation, camera, depth_row, rows):
    """Rows so that (u / z, v / z) are affine in the pixel, from gradients in world axes."""
    for t in range(2):
        g = np.zeros(3)
        for a in range(3):
            g[a] = rotation[a, 0] * gradient[t, 0] + rotation[a, 1] * gradient[t, 1] + rotation[a, 2] * gradient[t, 2]
        offset = gradient[t, 3] - (g[0] * rotation[0, 3] + g[1] * rotation[1, 3] + g[2] * rotation[2, 3])
        ax, ay = g[0] / camera[0], g[1] / camera[1]
        rows[t, 0] = ax + offset * depth_row[0]
        rows[t, 1] = ay + offset * depth_row[1]
        rows[t, 2] = g[2] - ax * camera[2] - ay * camera[3] + offset * depth_row[2]


@numba.njit(cache=True, fastmath={"nnan", "ninf", "nsz", "arcp", "contract"}, error_model="numpy")
def _paint(
    rgb, inverse_depth, owners, drawn, rejected, first_row, last_row, corners, corner_count, colour, texture, gradient, owner, alpha, grow, fog,
    rotation, camera, texels, level_offset, log_width, log_height, levels, haze, haze_m,
):  # fmt: skip
    width = inverse_depth.shape[1]
    cam = np.empty((MAX_CORNERS + 2, 3))
    edges = np.empty((MAX_CORNERS + 2, 3))
    extent = np.empty(4)
    depth_row = np.empty(3)
    rows = np.zeros((2, 3))
    for n in range(corners.shape[0]):
        left = _clip_near(corners[n], corner_count[n], rotation, cam)
        if left < 3:
            continue
        used = _edges(cam, left, camera, edges, extent)
        if used < 3 or not _inverse_depth_row(cam, left, camera, depth_row):
            continue
        reach = 0.5 + grow[n]
        y0 = max(first_row, int(np.ceil(max(extent[1] - reach, -1e6))))
        y1 = min(last_row - 1, int(np.floor(min(extent[3] + reach, 1e6))))
        if y0 > y1 or extent[2] + reach < 0 or extent[0] - reach > width - 1:
            continue
        nearest, farthest = 0.0, 1e9
        for k in range(left):
            nearest = max(nearest, 1.0 / cam[k, 2])
            farthest = min(farthest, 1.0 / cam[k, 2])
        if texture[n] >= 0:
            _texture_rows(gradient[n], rotation, camera, depth_row, rows)
        for y in range(y0, y1 + 1):
            low, high = max(0.0, extent[0] - reach), min(width - 1.0, extent[2] + reach)
            full_low, full_high = low, high
            for k in range(used):
                a = edges[k, 0]
                rest = edges[k, 1] * y + edges[k, 2]
                if abs(a) < 1e-9:
                    if rest < -reach:
                        high = low - 1
                    if rest < 0.5 - grow[n]:
                        full_high = full_low - 1
                elif a > 0:
                    low = max(low, (-reach - rest) / a)
                    full_low = max(full_low, (0.5 - grow[n] - rest) / a)
                else:
                    high = min(high, (-reach - rest) / a)
                    full_high = min(full_high, (0.5 - grow[n] - rest) / a)
            x0, x1 = int(np.ceil(low)), int(np.floor(high))
            if x0 > x1:
                continue
            solid0, solid1 = int(np.ceil(full_low)), int(np.floor(full_high))
            _paint_span(
                rgb[y], inverse_depth[y], owners[y], drawn, rejected, y, x0, x1, solid0, solid1, edges, used, reach,
                depth_row, nearest, farthest, rows, texture[n], colour[n], owner[n], alpha[n], fog[n],
                texels, level_offset, log_width, log_height, levels, haze, haze_m,
            )  # fmt: skip


@numba.njit(cache=True, fastmath={"nnan", "ninf", "nsz", "arcp", "contract"}, error_model="numpy")
def _paint_span(
    rgb, inverse_depth, owners, drawn, rejected, y, x0, x1, solid0, solid1, edges, used, reach,
    depth_row, nearest, farthest, rows, texture, colour, owner, alpha, fog,
    texels, level_offset, log_width, log_height, levels, haze, haze_m,
):  # fmt: skip
    one = np.float32(1.0)
    depth0 = depth_row[1] * y + depth_row[2]
    u_row, v_row = rows[0, 1] * y + rows[0, 2], rows[1, 1] * y + rows[1, 2]
    half = np.float32(1.0 / 255.0)
    for start in range(x0, x1 + 1, _SEGMENT):
        stop = min(start + _SEGMENT, x1 + 1)
        level, blend, taps, du, dv = 0, np.float32(0.0), 1, np.float32(0.0), np.float32(0.0)
        if texture >= 0:
            middle = 0.5 * (start + stop - 1)
            w = min(max(depth_row[0] * middle + depth0, farthest), nearest)
            u, v = (rows[0, 0] * middle + u_row) / w, (rows[1, 0] * middle + v_row) / w
            ux, uy = (rows[0, 0] - u * depth_row[0]) / w, (rows[0, 1] - u * depth_row[1]) / w
            vx, vy = (rows[1, 0] - v * depth_row[0]) / w, (rows[1, 1] - v * depth_row[1]) / w
            along_x, along_y = ux * ux + vx * vx, uy * uy + vy * vy
            major, minor = max(along_x, along_y), min(along_x, along_y)
            ratio = np.sqrt(major / max(minor, 1e-12))
            taps = min(_MAX_TAPS, max(1, int(np.ceil(ratio - 0.2))))
            detail = max(0.0, 0.5 * np.log2(max(major, 1e-12)) - np.log2(taps))
            detail = min(detail, levels[texture] - 1.001)
            level = int(detail)
            blend = np.float32(detail - level)
            if along_x > along_y:
                du, dv = np.float32(ux / taps), np.float32(vx / taps)
            else:
                du, dv = np.float32(uy / taps), np.float32(vy / taps)
        for x in range(start, stop):
            inv = min(max(depth_row[0] * x + depth0, farthest), nearest)
            if inv < inverse_depth[x] * _DEPTH_SLACK:
                rejected[owner] += 1
                continue
            cover = np.float32(alpha)
            if x < solid0 or x > solid1:
                distance = 1e9
                for k in range(used):
                    distance = min(distance, edges[k, 0] * x + edges[k, 1] * y + edges[k, 2])
                part = min(one, np.float32(distance + reach))
                if part <= 0:
                    continue
                cover *= part
            r, g, b = np.float32(255.0), np.float32(255.0), np.float32(255.0)
            if texture >= 0:
                u = np.float32((rows[0, 0] * x + u_row) / inv)
                v = np.float32((rows[1, 0] * x + v_row) / inv)
                sum3 = (np.float32(0.0), np.float32(0.0), np.float32(0.0))
                for extra in range(2):
                    weight = (blend if extra == 1 else one - blend) / np.float32(taps)
                    if weight < np.float32(0.02):
                        continue
                    at = level + extra
                    shrink = one / np.float32(1 << at)
                    mask_u = (1 << log_width[texture, at]) - 1
                    mask_v = (1 << log_height[texture, at]) - 1
                    for tap in range(taps):
                        shift = np.float32(tap) - np.float32(0.5 * (taps - 1))
                        sum3 = _texel(
                            texels, level_offset[texture, at], log_width[texture, at], mask_u, mask_v,
                            (u + du * shift) * shrink, (v + dv * shift) * shrink, weight, sum3,
                        )  # fmt: skip
                r, g, b = sum3
            r, g, b = r * colour[0] * half, g * colour[1] * half, b * colour[2] * half
            if fog > 0:
                haziness = np.float32(fog) / (one + np.float32(inv) * haze_m)
                r += (haze[0] - r) * haziness
                g += (haze[1] - g) * haziness
                b += (haze[2] - b) * haziness
            if cover >= np.float32(0.999):
                rgb[x, 0] = np.uint8(min(np.float32(255.0), r + np.float32(0.5)))
                rgb[x, 1] = np.uint8(min(np.float32(255.0), g + np.float32(0.5)))
                rgb[x, 2] = np.uint8(min(np.float32(255.0), b + np.float32(0.5)))
            else:
                rgb[x, 0] = np.uint8(min(np.float32(255.0), rgb[x, 0] + (r - rgb[x, 0]) * cover + np.float32(0.5)))
                rgb[x, 1] = np.uint8(min(np.float32(255.0), rgb[x, 1] + (g - rgb[x, 1]) * cover + np.float32(0.5)))
                rgb[x, 2] = np.uint8(min(np.float32(255.0), rgb[x, 2] + (b - rgb[x, 2]) * cover + np.float32(0.5)))
            if alpha >= np.float32(0.999) and cover >= np.float32(0.5):
                inverse_depth[x] = np.float32(inv)
                if owners[x] != owner:
                    owners[x] = np.uint8(owner)
                    drawn[owner] += 1
