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


def through(points, times, s):
    """The polynomial through the points at the times, by Lagrange's formula, at s."""
    result = [0.0] * len(points[0])
    for k, t in enumerate(times):
        weight = 1.0
        for j, u in enumerate(times):
            if j != k:
                weight *= (s - u) / (t - u)
        result = [r + weight * p for r, p in zip(result, points[k], strict=True)]
    return result


def on_arc(points, times, s):
    """The point of the circle through three points at s; depth by the polynomial. None where they lie on a line."""
    (ax, ay, _), (bx, by, _), (cx, cy, _) = points
    bend = (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
    if abs(bend) <= 1e-3 * math.hypot(bx - ax, by - ay) * math.hypot(cx - bx, cy - by):
        return None
    d = 2 * (ax * (by - cy) + bx * (cy - ay) + cx * (ay - by))
    ox = ((ax**2 + ay**2) * (by - cy) + (bx**2 + by**2) * (cy - ay) + (cx**2 + cy**2) * (ay - by)) / d
    oy = ((ax**2 + ay**2) * (cx - bx) + (bx**2 + by**2) * (ax - cx) + (cx**2 + cy**2) * (bx - ax)) / d
    angles = [math.atan2(y - oy, x - ox) for x, y, _ in points]
    for k in (1, 2):
        while (angles[k] - angles[k - 1]) * (1 if bend > 0 else -1) < 0:
            angles[k] += 2 * math.pi if bend > 0 else -2 * math.pi
    angle = through([[a] for a in angles], times, s)[0]
    radius = math.hypot(ax - ox, ay - oy)
    return [ox + radius * math.cos(angle), oy + radius * math.sin(angle), through(points, times, s)[2]]


def line_pixels(a, b):
    """Pixels of a segment, one at each pixel centre along its longer axis, start included, end not: (share, x, y)."""
    steep = abs(b[1] - a[1]) > abs(b[0] - a[0])
    p, q = (a[1], b[1]) if steep else (a[0], b[0])
    found = []
    for k in range(math.floor(min(p, q)) - 2, math.ceil(max(p, q)) + 3):
        centre = k + 0.5
        if p <= centre < q or q < centre <= p:
            share = (centre - p) / (q - p)
            other = (a[0] + share * (b[0] - a[0])) if steep else (a[1] + share * (b[1] - a[1]))
            found.append((share, math.floor(other), k) if steep else (share, k, math.floor(other)))
    return found


def guertin2015(color, offset, depth, times, options):
    """The scatter filter. offset [k][y][x] = (x, y), depth [k][y][x]; options: static (colour, depth) or None, arc,
    by_time, points, background_weight, sigma, counts [y][x] samples of a curve when by time.
    """
    height, width, now = len(color), len(color[0]), times.index(0.5)
    below = [[list(c) for c in row] for row in color]
    below_depth = [list(row) for row in depth[now]]
    moves = [[False] * width for _ in range(height)]
    for y in range(height):
        for x in range(width):
            far = max(math.hypot(*offset[k][y][x]) for k in range(len(times)))
            moves[y][x] = far > 0.5 and all(math.isfinite(depth[k][y][x]) for k in range(len(times)))
            if options["static"] is not None:
                z = depth[now][y][x]
                back, back_depth = options["static"][0][y][x], options["static"][1][y][x]
                stays = math.isfinite(z) and not moves[y][x] and z <= 1.01 * back_depth
                below[y][x], below_depth[y][x] = (list(color[y][x]), z) if stays else (list(back), back_depth)
    total = [[[0.0] * (len(color[0][0]) + 1) for _ in range(width)] for _ in range(height)]

    def add(source, target, z, weight):
        (x, y), (px, py) = source, target
        if 0 <= px < width and 0 <= py < height and z <= 1.01 * below_depth[py][px]:
            for c, value in enumerate([*color[y][x], 1.0]):
                total[py][px][c] += weight * value

    for y in range(height):
        for x in range(width):
            if not moves[y][x]:
                continue
            points = [
                [x + 0.5 + offset[k][y][x][0], y + 0.5 + offset[k][y][x][1], depth[k][y][x]] for k in range(len(times))
            ]

            def place(s, points=points):
                arc = on_arc(points, times, s) if options["arc"] else None
                return through(points, times, s) if arc is None else arc

            if options["by_time"]:
                m = options["counts"][y][x]
                for k in range(m):
                    px, py, z = place((k + 0.5) / m)
                    add((x, y), (math.floor(px), math.floor(py)), z, 1 / m)
                continue
            n = options["points"] - 1
            for k in range(n):
                a, b = (
                    [round(256 * p[0]) / 256, round(256 * p[1]) / 256, p[2]] for p in (place(k / n), place((k + 1) / n))
                )
                for share, px, py in line_pixels(a, b):
                    weight = math.exp(-0.5 * (((k + share) / n - 0.5) / options["sigma"]) ** 2)
                    add((x, y), (px, py), a[2] + share * (b[2] - a[2]), weight)
    result = []
    for y in range(height):
        result.append([])
        for x in range(width):
            *light, alpha = total[y][x]
            rest = max(0.0, 1 - alpha) if options["by_time"] else options["background_weight"]
            over = max(1.0, alpha) if options["by_time"] else alpha + options["background_weight"]
            result[y].append([(a + rest * c) / over for a, c in zip(light, below[y][x], strict=True)])
    return result
