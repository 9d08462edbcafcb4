"""The synthetic street's scan converter: convex polygons, painted in the order given, with a depth test.

Every polygon is planar and convex, lies in 3-D, and is either flat-coloured or carries a texture with an affine map.
For a pixel with ray ``d = ((x-cx)/fx, (y-cy)/fy, 1)`` and a plane ``n.X = c`` the inverse depth is ``n.d / c``, affine
in the pixel, and a texture coordinate is ``(g.d) / inverse_depth + g0`` (perspective-correct). Edges blend by the
distance of the pixel's centre to the edge. Textures are read trilinearly from a mip chain (Williams 1983) with several
taps along the longer axis of the pixel's footprint (Heckbert 1989).

All in one module, since the cache of a compiled function sees changes in its own file alone. Helpers of the loop over
polygons take few arrays: one more call for each polygon with all of them makes painting 5 % slower.
"""

import numba
import numpy as np

from dataset.street_polygons import MAX_CORNERS, Atlas, Canvas, Polygons

_NEAR_M = 0.12
_SEGMENT = 12
# A surface this much farther (relative) than what is painted still wins: decals lie on their host, painted after it.
_DEPTH_SLACK = 0.985
_FAST = {"nnan", "ninf", "nsz", "arcp", "contract"}


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
    shading = (
        polygons.colour, polygons.texture, polygons.fog, atlas.texels, atlas.offset, atlas.log_width, atlas.log_height,
        atlas.levels, atlas.taps, np.array(haze, np.float32), np.float32(haze_m),
    )  # fmt: skip
    count = len(polygons)
    plan = np.empty((count, 3)), np.zeros((count, 2, 3)), np.empty((count, 2))
    waiting = np.full(canvas.owner.shape, -1, np.int32)
    shapes = polygons.corners, polygons.corner_count, polygons.soft, polygons.gradient, polygons.texture
    _scan(
        (canvas.rgb, canvas.inverse_depth, canvas.owner, waiting), (drawn, rejected), (first, last), shapes,
        (polygons.owner, polygons.alpha, polygons.grow_px),
        (world_to_cam.astype(np.float64), np.array(camera, np.float64)), plan, shading,
    )  # fmt: skip
    _shade_waiting(canvas.rgb, waiting, first, last, plan, shading)
    return drawn, rejected


@numba.njit(cache=True, inline="always")
def _texel(texels, start, log_width, mask_u, mask_v, u, v, weight):
    """``weight`` (0 to 4096) times the bilinear sample at (u, v) of one level, three sums in one integer.

    A texel packs red, green and blue into lanes of 21 bits: eight of colour under twelve of weight leave one spare, so
    one multiplication weighs all three and the lanes never touch.
    """
    fu = u - np.float32(0.5)
    fv = v - np.float32(0.5)
    floor_u = np.floor(fu)
    floor_v = np.floor(fv)
    au = (fu - floor_u) * weight
    av = fv - floor_v
    half = np.float32(0.5)
    w11 = np.int64(au * av + half)
    w01 = np.int64(au + half) - w11
    w10 = np.int64(weight * av + half) - w11
    w00 = np.int64(weight + half) - w01 - w10 - w11
    u0 = np.int64(floor_u) & mask_u
    u1 = (u0 + 1) & mask_u
    v0 = np.int64(floor_v) & mask_v
    v1 = (v0 + 1) & mask_v
    a = start + (v0 << log_width)
    b = start + (v1 << log_width)
    return texels[a + u0] * w00 + texels[a + u1] * w01 + texels[b + u0] * w10 + texels[b + u1] * w11


@numba.njit(cache=True, error_model="numpy")
def _clip_near(corners, count, soft, rotation, cam, out):
    """Corners into camera axes, cut at the near plane (Sutherland and Hodgman 1974); returns how many are left."""
    ahead = 0
    for k in range(count):
        x, y, z = corners[k, 0], corners[k, 1], corners[k, 2]
        for a in range(3):
            cam[k, a] = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z + rotation[a, 3]
        if cam[k, 2] >= _NEAR_M:
            ahead += 1
    if ahead == 0:
        return 0
    left = 0
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        if cam[k, 2] >= _NEAR_M:
            for a in range(3):
                out[left, a] = cam[k, a]
            out[left, 3] = (soft >> k) & 1
            left += 1
        if (cam[k, 2] >= _NEAR_M) != (cam[m, 2] >= _NEAR_M):
            t = (_NEAR_M - cam[k, 2]) / (cam[m, 2] - cam[k, 2])
            for a in range(3):
                out[left, a] = cam[k, a] + t * (cam[m, a] - cam[k, a])
            out[left, 3] = (soft >> k) & 1 if cam[m, 2] >= _NEAR_M else 0
            left += 1
    return left


@numba.njit(cache=True, error_model="numpy")
def _edges(cam, left, camera, screen, edges, extent):
    """Inward edge lines (a, b, c, soft) with unit normals, and the extent; returns how many, 0 without area."""
    x0, y0, x1, y1 = 1e9, 1e9, -1e9, -1e9
    for k in range(left):
        x = camera[0] * cam[k, 0] / cam[k, 2] + camera[2]
        y = camera[1] * cam[k, 1] / cam[k, 2] + camera[3]
        screen[k, 0], screen[k, 1] = x, y
        x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
    extent[0], extent[1], extent[2], extent[3] = x0, y0, x1, y1
    area = 0.0
    for k in range(left):
        m = k + 1 if k + 1 < left else 0
        area += screen[k, 0] * screen[m, 1] - screen[m, 0] * screen[k, 1]
    if abs(area) < 1e-6:
        return 0
    sign = 1.0 if area > 0 else -1.0
    used = 0
    for k in range(left):
        m = k + 1 if k + 1 < left else 0
        dx, dy = screen[m, 0] - screen[k, 0], screen[m, 1] - screen[k, 1]
        length = np.sqrt(dx * dx + dy * dy)
        if length < 1e-7:
            continue
        edges[used, 0] = -dy / length * sign
        edges[used, 1] = dx / length * sign
        edges[used, 3] = cam[k, 3]
        edges[used, 2] = -(edges[used, 0] * screen[k, 0] + edges[used, 1] * screen[k, 1])
        used += 1
    return used


@numba.njit(cache=True)
def _inverse_depth_row(cam, left, camera, row):
    """1/z = row[0] x + row[1] y + row[2] over pixels, by Newell's normal; returns False for a plane seen edge on."""
    nx, ny, nz, mx, my, mz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(left):
        m = k + 1 if k + 1 < left else 0
        nx += (cam[k, 1] - cam[m, 1]) * (cam[k, 2] + cam[m, 2])
        ny += (cam[k, 2] - cam[m, 2]) * (cam[k, 0] + cam[m, 0])
        nz += (cam[k, 0] - cam[m, 0]) * (cam[k, 1] + cam[m, 1])
        mx += cam[k, 0] / left
        my += cam[k, 1] / left
        mz += cam[k, 2] / left
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
        x, y, z = gradient[t, 0], gradient[t, 1], gradient[t, 2]
        gx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
        gy = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
        gz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        offset = gradient[t, 3] - (gx * rotation[0, 3] + gy * rotation[1, 3] + gz * rotation[2, 3])
        ax, ay = gx / camera[0], gy / camera[1]
        rows[t, 0] = ax + offset * depth_row[0]
        rows[t, 1] = ay + offset * depth_row[1]
        rows[t, 2] = gz - ax * camera[2] - ay * camera[3] + offset * depth_row[2]


@numba.njit(cache=True, error_model="numpy")
def _row_bounds(edges, used, y, width, extent, grow):
    """Where row ``y`` meets a polygon: from, to; and from, to of what it covers wholly."""
    reach = 0.5 + grow
    low, high = max(0.0, extent[0] - reach), min(width - 1.0, extent[2] + reach)
    full_low, full_high = low, high
    for k in range(used):
        a = edges[k, 0]
        rest = edges[k, 1] * y + edges[k, 2]
        outer, inner = (-reach, 0.5 - grow) if edges[k, 3] > 0 else (0.0, 0.0)
        if abs(a) < 1e-9:
            if rest < outer:
                high = low - 1
            if rest < inner:
                full_high = full_low - 1
        elif a > 0:
            low, full_low = max(low, (outer - rest) / a), max(full_low, (inner - rest) / a)
        else:
            high, full_high = min(high, (outer - rest) / a), min(full_high, (inner - rest) / a)
    return low, high, full_low, full_high


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _inverse_depth_span(cam, left, span):
    """The least and the greatest 1/z of a polygon's corners, with a little room."""
    span[0], span[1] = 1e9, 0.0
    for k in range(left):
        span[0] = min(span[0], 0.98 / cam[k, 2])
        span[1] = max(span[1], 1.02 / cam[k, 2])


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _rows_met(extent, grow, width, rows):
    """First and last row that a polygon meets, of those ``[start, end)`` that are painted; the last is before the first
    where it meets none."""
    reach = 0.5 + grow
    if extent[2] + reach < 0 or extent[0] - reach > width - 1:
        return 0, -1
    y0 = max(rows[0], int(np.ceil(max(extent[1] - reach, -1e6))))
    y1 = min(rows[1] - 1, int(np.floor(min(extent[3] + reach, 1e6))))
    return y0, y1


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _note_solid(n, mine, x0, x1, depth_x, depth0, least, most, depth_line, waiting_line, owner_line):
    """Pixels that polygon ``n`` hides wholly: where it is the nearest they wait for it; how many are new and lost."""
    slack = np.float32(_DEPTH_SLACK)
    new, lost = 0, 0
    for x in range(x0, x1 + 1):
        inv = np.float32(min(max(depth_x * x + depth0, least), most))
        if inv < depth_line[x] * slack:
            lost += owner_line[x] != mine
        else:
            waiting_line[x] = n
            depth_line[x] = inv
            new += owner_line[x] != mine
            owner_line[x] = mine
    return new, lost


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _edge_distance(edges, used, x, y):
    """Pixels from a pixel's centre to the nearest soft edge, negative outside."""
    distance = 1e9
    for k in range(used):
        if edges[k, 3] > 0:
            distance = min(distance, edges[k, 0] * x + edges[k, 1] * y + edges[k, 2])
    return distance


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _scan(picture, tallies, bounds, shapes, looks, view, plan, shading):
    """Scan-convert all polygons. Whole pixels are only noted in ``waiting`` and shaded at the end (or when something is
    blended over them), so that what is painted over costs no texture reads."""
    rgb, inverse_depth, owners, waiting = picture
    drawn, rejected = tallies
    corners, corner_count, soft, gradient, texture = shapes
    owner, alpha, grow = looks
    rotation, camera = view
    width = inverse_depth.shape[1]
    depth_rows, texture_rows, spans = plan
    whole, cam, screen = np.empty((MAX_CORNERS, 3)), np.empty((MAX_CORNERS + 2, 4)), np.empty((MAX_CORNERS + 2, 2))
    edges, extent = np.empty((MAX_CORNERS + 2, 4)), np.empty(4)
    slack = np.float32(_DEPTH_SLACK)
    for n in range(len(corners)):
        left = _clip_near(corners[n], corner_count[n], soft[n], rotation, whole, cam)
        if left < 3:
            continue
        used = _edges(cam, left, camera, screen, edges, extent)
        if used < 3 or not _inverse_depth_row(cam, left, camera, depth_rows[n]):
            continue
        y0, y1 = _rows_met(extent, grow[n], width, bounds)
        if y0 > y1:
            continue
        _inverse_depth_span(cam, left, spans[n])
        if texture[n] >= 0:
            _texture_rows(gradient[n], rotation, camera, depth_rows[n], texture_rows[n])
        reach, mine = 0.5 + grow[n], np.uint8(owner[n])
        for y in range(y0, y1 + 1):
            low, high, full_low, full_high = _row_bounds(edges, used, y, width, extent, grow[n])
            x0, x1 = int(np.ceil(low)), int(np.floor(high))
            if x0 > x1:
                continue
            solid0, solid1 = max(x0, int(np.ceil(full_low))), min(x1, int(np.floor(full_high)))
            whole0, whole1 = solid0, solid1
            if solid1 < solid0 or alpha[n] < np.float32(0.999):
                solid0, solid1 = x1 + 1, x1
            # Locals: what is stored below could alias the arrays, so the compiler would read them again at each pixel.
            depth_x, depth0 = depth_rows[n, 0], depth_rows[n, 1] * y + depth_rows[n, 2]
            least, most = spans[n, 0], spans[n, 1]
            depth_line, waiting_line, owner_line = inverse_depth[y], waiting[y], owners[y]
            new, lost = _note_solid(
                n, mine, solid0, solid1, depth_x, depth0, least, most, depth_line, waiting_line, owner_line
            )
            drawn[mine] += new
            rejected[mine] += lost
            for piece in range(2):
                start, stop = (x0, solid0) if piece == 0 else (solid1 + 1, x1 + 1)
                for x in range(start, stop):
                    distance = 1e9
                    if x < whole0 or x > whole1:
                        distance = _edge_distance(edges, used, x, y)
                    cover = min(np.float32(1.0), np.float32(distance + reach)) * alpha[n]
                    if cover <= 0:
                        continue
                    inv = np.float32(min(max(depth_x * x + depth0, least), most))
                    if inv < depth_line[x] * slack:
                        rejected[mine] += owner_line[x] != mine
                        continue
                    under = waiting_line[x]
                    waiting_line[x] = -1
                    for layer in range(0 if under >= 0 else 1, 2):
                        who, opacity = (under, np.float32(1.0)) if layer == 0 else (n, cover)
                        _shade(rgb, who, y, x, x + 1, plan, shading, opacity)
                    if alpha[n] >= np.float32(0.999) and cover >= np.float32(0.5):
                        depth_line[x] = inv
                        drawn[mine] += owner_line[x] != mine
                        owner_line[x] = mine


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _shade_waiting(rgb, waiting, first_row, last_row, plan, shading):
    """Shade all pixels that wait, in runs of one polygon."""
    width = waiting.shape[1]
    for y in range(first_row, last_row):
        line = waiting[y]
        x = 0
        while x < width:
            n = line[x]
            stop = x + 1
            while stop < width and line[stop] == n and stop - x < _SEGMENT:
                stop += 1
            if n >= 0:
                _shade(rgb, n, y, x, stop, plan, shading, np.float32(1.0))
            x = stop


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy", inline="always")
def _choose_reading(ux, vx, uy, vy, most_taps, levels):
    """How a texture is read under a footprint.

    Args:
        ux, vx: texels that a step of one pixel to the right crosses.
        uy, vy: and one of a pixel down.
        most_taps: of its samples along the longer of the two, at most.
        levels: how many it has.

    Returns:
        How many samples; the step between them (du, dv); the level, and the share of the one after it.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    along_x, along_y = ux * ux + vx * vx, uy * uy + vy * vy
    major, minor = max(along_x, along_y), min(along_x, along_y)
    ratio = np.sqrt(major / max(minor, 1e-12))
    taps = min(most_taps, max(1, int(np.ceil(ratio - 0.2))))
    detail = max(0.0, 0.5 * np.log2(max(major, 1e-12) / (taps * taps)))
    detail = min(detail, levels - 1.34)
    level = int(detail)
    # Levels blend over the middle third only: two thirds of the pixels then read one level, and no step shows.
    blend = min(one, max(zero, (np.float32(detail - level) - np.float32(0.33)) * np.float32(3.0)))
    if blend == one:
        level, blend = level + 1, zero
    if along_x > along_y:
        du, dv = np.float32(ux / taps), np.float32(vx / taps)
    else:
        du, dv = np.float32(uy / taps), np.float32(vy / taps)
    return taps, du, dv, level, blend


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy", inline="always")
def _read(texels, u, v, taps, du, dv, shrink, weight0, weight1, start0, start1, width0, mask_u0, mask_v0):
    """The texture about (u, v) of level 0: the sum of its weighted samples, packed as a texel is."""
    half = np.float32(0.5)
    centre = half * np.float32(taps - 1)
    packed = np.int64(0)
    for tap in range(taps):
        shift = np.float32(tap) - centre
        u1, v1 = (u + du * shift) * shrink, (v + dv * shift) * shrink
        packed += _texel(texels, start0, width0, mask_u0, mask_v0, u1, v1, weight0)
        if weight1 > np.float32(0.0):
            u1 *= half
            v1 *= half
            packed += _texel(texels, start1, width0 - 1, mask_u0 >> 1, mask_v0 >> 1, u1, v1, weight1)
    return packed


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy", inline="always")
def _shade(rgb, n, y, x0, x1, plan, shading, cover):
    """Colour pixels ``[x0, x1)`` of row ``y`` by polygon ``n``; the level of detail is that of their middle."""
    depth_rows, rows, spans = plan
    colours, textures, fogs, texels, level_offset, log_width, log_height, levels, texture_taps, haze, haze_m = shading
    one = np.float32(1.0)
    texture = textures[n]
    farthest, nearest = spans[n, 0], spans[n, 1]
    depth_x, depth0 = depth_rows[n, 0], depth_rows[n, 1] * y + depth_rows[n, 2]
    u_row, v_row = rows[n, 0, 1] * y + rows[n, 0, 2], rows[n, 1, 1] * y + rows[n, 1, 2]
    u_x, v_x = rows[n, 0, 0], rows[n, 1, 0]
    scale = np.float32(1.0 / 255.0 / 4096.0)
    half, zero = np.float32(0.5), np.float32(0.0)
    taps, du, dv, weight0, weight1, shrink = 1, zero, zero, zero, zero, one
    start0, start1, width0, mask_u0, mask_v0 = np.int64(0), np.int64(0), np.int64(0), 1, 1
    if texture >= 0:
        middle = 0.5 * (x0 + x1 - 1)
        z = 1.0 / min(max(depth_x * middle + depth0, farthest), nearest)
        u, v = (u_x * middle + u_row) * z, (v_x * middle + v_row) * z
        ux, uy = (u_x - u * depth_x) * z, (rows[n, 0, 1] - u * depth_rows[n, 1]) * z
        vx, vy = (v_x - v * depth_x) * z, (rows[n, 1, 1] - v * depth_rows[n, 1]) * z
        taps, du, dv, level, blend = _choose_reading(ux, vx, uy, vy, texture_taps[texture], levels[texture])
        weight0 = (one - blend) * np.float32(4096.0) / np.float32(taps)
        weight1 = blend * np.float32(4096.0) / np.float32(taps)
        shrink = one / np.float32(1 << level)
        start0, start1 = level_offset[texture, level], level_offset[texture, level + 1]
        width0 = np.int64(log_width[texture, level])
        mask_u0, mask_v0 = (1 << width0) - 1, (1 << np.int64(log_height[texture, level])) - 1
    red, green, blue, fog = colours[n, 0], colours[n, 1], colours[n, 2], fogs[n]
    haze_r, haze_g, haze_b = haze[0], haze[1], haze[2]
    top, line = np.float32(255.0), rgb[y]
    for x in range(x0, x1):
        inv = min(max(depth_x * x + depth0, farthest), nearest)
        r, g, b = red, green, blue
        if texture >= 0:
            z = 1.0 / inv
            packed = _read(
                texels, np.float32((u_x * x + u_row) * z), np.float32((v_x * x + v_row) * z), taps, du, dv, shrink,
                weight0, weight1, start0, start1, width0, mask_u0, mask_v0,
            )  # fmt: skip
            r *= np.float32(packed & 0x1FFFFF) * scale
            g *= np.float32((packed >> 21) & 0x1FFFFF) * scale
            b *= np.float32(packed >> 42) * scale
        haziness = fog / (one + np.float32(inv) * haze_m)
        r += (haze_r - r) * haziness
        g += (haze_g - g) * haziness
        b += (haze_b - b) * haziness
        if cover < one:
            r = line[x, 0] + (r - line[x, 0]) * cover
            g = line[x, 1] + (g - line[x, 1]) * cover
            b = line[x, 2] + (b - line[x, 2]) * cover
        line[x, 0] = np.uint8(np.int32(min(top, r + half)))
        line[x, 1] = np.uint8(np.int32(min(top, g + half)))
        line[x, 2] = np.uint8(np.int32(min(top, b + half)))
