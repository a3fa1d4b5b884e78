"""The published filters, pixel by pixel and tap by tap in plain Python, as slow as they are easy to check.

Images are lists of rows: colour [y][x] is a list of channels, motion [y][x] = (x, y) over the whole exposure, depth
[y][x] the positive view depth. Imports nothing of ours.
Source: the pseudo-code of McGuire et al. 2012 and Guertin et al. 2014, with z = -depth as it is there.
"""

import math


def clamp(value, low, high):
    return max(low, min(high, value))


def smoothstep(a, b, x):
    s = clamp((x - a) / (b - a), 0.0, 1.0)
    return s * s * (3 - 2 * s)


def cone(distance, radius):
    return clamp(1 - distance / radius, 0.0, 1.0)


def cylinder(distance, radius):
    return 1 - smoothstep(0.95 * radius, 1.05 * radius, distance)


def half_velocity(motion, k):
    """V and |V|: half of the motion, its length between 1/2 and k."""
    q = (0.5 * motion[0], 0.5 * motion[1])
    length = math.hypot(*q)
    limited = clamp(length, 0.5, k)
    return (q[0] * limited / (length + 1e-5), q[1] * limited / (length + 1e-5)), limited


def tiles_of(v, k):
    """The longest V of each tile."""
    height, width = len(v), len(v[0])
    rows, columns = math.ceil(height / k), math.ceil(width / k)
    tiles = [[(0.0, 0.0)] * columns for _ in range(rows)]
    for y in range(height):
        for x in range(width):
            if math.hypot(*v[y][x]) > math.hypot(*tiles[y // k][x // k]):
                tiles[y // k][x // k] = v[y][x]
    return tiles


def around(tiles, row, column):
    """Offsets and values of the 3 x 3 tiles that exist."""
    for t in (-1, 0, 1):
        for s in (-1, 0, 1):
            if 0 <= row + t < len(tiles) and 0 <= column + s < len(tiles[0]):
                yield s, t, tiles[row + t][column + s]


def mcguire2012(color, motion, depth, samples, k, soft_z, noise):
    """`reconstruct`; noise [y][x] in [0, 1), or None."""
    height, width = len(color), len(color[0])
    pairs = [[half_velocity(m, k) for m in row] for row in motion]
    v = [[p[0] for p in row] for row in pairs]
    speed = [[p[1] for p in row] for row in pairs]
    tiles = tiles_of(v, k)

    def soft_depth_compare(za, zb):
        return clamp(1 - (za - zb) / soft_z, 0.0, 1.0)

    result = [[None] * width for _ in range(height)]
    for y in range(height):
        for x in range(width):
            vn = max((value for _, _, value in around(tiles, y // k, x // k)), key=lambda u: math.hypot(*u))
            if math.hypot(*vn) <= 0.5 + 1e-5:
                result[y][x] = list(color[y][x])
                continue
            weight = 1 / speed[y][x]
            total = [weight * c for c in color[y][x]]
            j = 0.0 if noise is None else noise[y][x] - 0.5
            for i in range(samples):
                if i == (samples - 1) // 2:
                    continue
                t = -1 + 2 * (i + j + 1) / (samples + 1)
                px, py = math.floor(x + t * vn[0] + 0.5), math.floor(y + t * vn[1] + 0.5)
                bx, by = int(clamp(px, 0, width - 1)), int(clamp(py, 0, height - 1))
                z_here, z_there = -depth[y][x], -depth[by][bx]
                same = z_here == z_there  # also both infinite
                f = 1.0 if same else soft_depth_compare(z_here, z_there)
                b = 1.0 if same else soft_depth_compare(z_there, z_here)
                d = math.hypot(px - x, py - y)
                r_here, r_there = speed[y][x], speed[by][bx]
                a = f * cone(d, r_there) + b * cone(d, r_here) + 2 * cylinder(d, r_there) * cylinder(d, r_here)
                weight += a
                total = [s + a * c for s, c in zip(total, color[by][bx], strict=True)]
            result[y][x] = [s / weight for s in total]
    return result


def unit(v):
    length = max(math.hypot(*v), 0.5)
    return v[0] / length, v[1] / length


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1]


def sign(x):
    return (x > 0) - (x < 0)


def relative_depth_compare(za, zb):
    """za, zb negative; 1 where b is not behind a."""
    if za == zb:
        return 1.0
    if math.isinf(za) or math.isinf(zb):
        return 1.0 if za < zb else 0.0
    return clamp(1 - (za - zb) / min(-za, -zb), 0.0, 1.0)


def guertin2014(color, motion, depth, samples, k, noise):
    """The filter of 2014; noise [3][y][x] in [0, 1), or None."""
    height, width = len(color), len(color[0])
    pairs = [[half_velocity(m, k) for m in row] for row in motion]
    v = [[p[0] for p in row] for row in pairs]
    speed = [[p[1] for p in row] for row in pairs]
    tiles = tiles_of(v, k)
    neighbour_max, variance = [], []
    for row in range(len(tiles)):
        neighbour_max.append([])
        variance.append([])
        for column in range(len(tiles[0])):
            near = list(around(tiles, row, column))
            allowed = [u for s, t, u in near if abs(sign(s * u[0]) + sign(t * u[1])) == abs(s) + abs(t)]
            best = max(allowed, key=lambda u: math.hypot(*u))
            neighbour_max[row].append(best)
            variance[row].append(1 - sum(abs(dot(unit(best), unit(u))) for _, _, u in near) / len(near))
    result = [[None] * width for _ in range(height)]
    for y in range(height):
        for x in range(width):
            shift = (0.0, 0.0) if noise is None else (0.5 * (noise[1][y][x] - 0.5), 0.5 * (noise[2][y][x] - 0.5))
            column = int(clamp(math.floor((x + 0.5) / k + shift[0]), 0, len(tiles[0]) - 1))
            row = int(clamp(math.floor((y + 0.5) / k + shift[1]), 0, len(tiles) - 1))
            v_max, u = neighbour_max[row][column], variance[row][column]
            length = math.hypot(*v_max)
            if length <= 0.5 + 1e-5:
                result[y][x] = list(color[y][x])
                continue
            wn, vc = unit(v_max), v[y][x]
            wp = (-wn[1], wn[0])
            if dot(wp, vc) < 0:
                wp = (-wp[0], -wp[1])
            s = clamp((speed[y][x] - 0.5) / 1.5, 0.0, 1.0)
            mixed = tuple(a * (1 - s) + b * s for a, b in zip(wp, unit(vc), strict=True))
            wc = tuple(a / math.hypot(*mixed) for a in mixed)
            weight = samples / (40 * speed[y][x])
            total = [weight * c for c in color[y][x]]
            j = 0.0 if noise is None else (2 * noise[0][y][x] - 1) * 0.95 * 27 / samples
            for i in range(samples):
                t = -1 + 2 * (i + j + 1) / (samples + 1)
                d = wc if math.floor((i + 1) * u) > math.floor(i * u) else wn
                px, py = x + math.floor(t * length * d[0] + 0.5), y + math.floor(t * length * d[1] + 0.5)
                bx, by = int(clamp(px, 0, width - 1)), int(clamp(py, 0, height - 1))
                travelled = abs(t) * length
                f = relative_depth_compare(-depth[y][x], -depth[by][bx])
                b = relative_depth_compare(-depth[by][bx], -depth[y][x])
                wa, wb = abs(dot(wc, d)), abs(dot(unit(v[by][bx]), d))
                r_here, r_there = speed[y][x], speed[by][bx]
                a = f * cone(travelled, r_there) * wb + b * cone(travelled, r_here) * wa
                a += 2 * cylinder(travelled, min(r_there, r_here)) * max(wa, wb)
                weight += a
                total = [q + a * c for q, c in zip(total, color[by][bx], strict=True)]
            result[y][x] = [q / weight for q in total]
    return result


def bilinear(color, x, y):
    """Colour between pixels; beyond the border the border's."""
    height, width = len(color), len(color[0])
    x, y = clamp(x, 0.0, width - 1), clamp(y, 0.0, height - 1)
    x0, y0 = math.floor(x), math.floor(y)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    result = []
    for c in range(len(color[0][0])):
        top = color[y0][x0][c] * (1 - x + x0) + color[y0][x1][c] * (x - x0)
        bottom = color[y1][x0][c] * (1 - x + x0) + color[y1][x1][c] * (x - x0)
        result.append(top * (1 - y + y0) + bottom * (y - y0))
    return result


def directional(color, motion, samples):
    """The mean along each pixel's own motion."""
    result = []
    for y, row in enumerate(color):
        result.append([])
        for x, here in enumerate(row):
            m = motion[y][x]
            taps = [
                bilinear(color, x + t * m[0], y + t * m[1]) for t in ((k + 0.5) / samples - 0.5 for k in range(samples))
            ]
            mean = [sum(c) / samples for c in zip(*taps, strict=True)]
            result[y].append(list(here) if math.hypot(*m) <= 1 else mean)
    return result


def motion_kernel(size, angle_deg):
    """A line of equal weights in the middle row, turned counter-clockwise as displayed, and scaled to sum 1."""
    middle = size // 2
    line = [[[1.0 if y == middle else 0.0] for x in range(size + 2)] for y in range(size + 2)]
    for y in range(size + 2):
        for x in range(size + 2):  # a frame of zeros, as nothing lies outside
            line[y][x][0] = 1.0 if y == middle + 1 and 1 <= x <= size else 0.0
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    kernel = []
    for y in range(size):
        kernel.append([])
        for x in range(size):
            dx, dy = x - middle, y - middle
            kernel[y].append(bilinear(line, middle + 1 + c * dx - s * dy, middle + 1 + s * dx + c * dy)[0])
    total = sum(map(sum, kernel))
    return [[k / total for k in row] for row in kernel]


def directional_image(color, motion):
    """One kernel for the whole image."""
    size = 2 * math.floor(math.hypot(*motion) / 2) + 1
    height, width, middle = len(color), len(color[0]), size // 2
    kernel = motion_kernel(size, math.degrees(math.atan2(-motion[1], motion[0])))
    result = []
    for y in range(height):
        result.append([])
        for x in range(width):
            total = [0.0] * len(color[0][0])
            for v in range(size):
                for u in range(size):
                    px, py = int(clamp(x + u - middle, 0, width - 1)), int(clamp(y + v - middle, 0, height - 1))
                    total = [s + kernel[v][u] * c for s, c in zip(total, color[py][px], strict=True)]
            result[y].append(total)
    return result
