"""A second formulation of everything, in Python floats and loops; nothing shared with the oracle.

One record per (Gaussian, pixel) pair that the host would visit, in blend order; images, counts and
the thresholds' gradient are sums over records.
"""

import math
from dataclasses import dataclass

from fragprune_plugins.types import RasterInputs

W = 0.01


@dataclass
class Splat:
    row: int
    pixel: tuple[float, float]
    cov: tuple[float, float, float]
    depth: float
    opacity: float
    color: list[float]
    radius: int
    rect: tuple[int, int, int, int]
    tau: float | None


@dataclass
class Record:
    row: int
    q: float
    alpha: float
    drawn: bool
    rim: bool
    slope: float
    light: float
    color: list[float]
    depth: float


def times(row, matrix):
    return [sum(a * matrix[i][j] for i, a in enumerate(row)) for j in range(len(matrix[0]))]


def rotate(quaternion, vector):
    """q v q*, by the cross-product form."""
    w, *u = quaternion
    cross = lambda a, b: [  # noqa: E731
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
    t = [2 * c for c in cross(u, vector)]
    return [v + w * a + b for v, a, b in zip(vector, t, cross(u, t), strict=True)]


def harmonic(degree, order, direction):
    """Real spherical harmonic with the Condon-Shortley phase, from Legendre functions."""
    from scipy.special import lpmv

    x, y, z = direction
    m = abs(order)
    norm = math.sqrt(
        (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
    )
    value = norm * float(lpmv(m, degree, z))
    phi = math.atan2(y, x)
    if order > 0:
        return math.sqrt(2) * value * math.cos(m * phi)
    return math.sqrt(2) * value * math.sin(m * phi) if order < 0 else value


def color_of(splats, row, campos):
    if splats.colors is not None:
        return splats.colors[row].tolist()
    offset = [a - b for a, b in zip(splats.means[row].tolist(), campos, strict=True)]
    length = math.dist(offset, (0, 0, 0))
    direction = [c / length for c in offset]
    orders = [(d, m) for d in range(splats.sh_degree + 1) for m in range(-d, d + 1)]
    basis = [harmonic(d, m, direction) for d, m in orders]
    sh = splats.sh[row].tolist()
    return [max(0.0, 0.5 + sum(b * sh[k][c] for k, b in enumerate(basis))) for c in range(3)]


def covariance_3d(splats, row, modifier):
    if splats.cov3d is not None:
        a, b, c, d, e, f = splats.cov3d[row].tolist()
        return [[a, b, c], [b, d, e], [c, e, f]]
    quaternion, scales = splats.rotations[row].tolist(), splats.scales[row].tolist()
    axes = [rotate(quaternion, [float(i == k) for i in range(3)]) for k in range(3)]
    return [
        [
            sum((modifier * scales[k]) ** 2 * axes[k][i] * axes[k][j] for k in range(3))
            for j in range(3)
        ]
        for i in range(3)
    ]


def covariance_2d(inputs, row, point):
    view = inputs.view
    cov, out = covariance_3d(inputs.splats, row, inputs.scale_modifier), []
    rotation = view.viewmatrix.tolist()
    gradients = []
    for size, tan, axis in ((view.width, view.tan_fov_x, 0), (view.height, view.tan_fov_y, 1)):
        slope = max(-1.3 * tan, min(1.3 * tan, point[axis] / point[2]))
        focal = size / (2 * tan)
        gradients.append(
            [focal / point[2] * (rotation[i][axis] - slope * rotation[i][2]) for i in range(3)]
        )
    for a, b in ((0, 0), (0, 1), (1, 1)):
        pairs = ((i, j) for i in range(3) for j in range(3))
        out.append(sum(gradients[a][i] * cov[i][j] * gradients[b][j] for i, j in pairs))
    return out


def splats_of(inputs: RasterInputs, thresholds=None) -> list[Splat]:
    view, found = inputs.view, []
    grid = (math.ceil(view.width / 16), math.ceil(view.height / 16))
    for row in range(len(inputs.splats)):
        homogeneous = [*inputs.splats.means[row].tolist(), 1.0]
        point = times(homogeneous, view.viewmatrix.tolist())
        if point[2] <= inputs.near:
            continue
        clip = times(homogeneous, view.projmatrix.tolist())
        sizes = (view.width, view.height)
        at = [((clip[k] / (clip[3] + 1e-7) + 1) * sizes[k] - 1) / 2 for k in (0, 1)]
        a, b, c = covariance_2d(inputs, row, point)
        before, (a, c) = a * c - b * b, (a + inputs.dilation, c + inputs.dilation)
        det = a * c - b * b
        if det == 0:
            continue
        opacity = inputs.splats.opacities[row].item()
        if inputs.compensation == "antialiasing":
            opacity *= math.sqrt(max(2.5e-5, before / det))
        elif inputs.compensation == "mip":
            draws = before > 1e-6 and det > 1e-6
            opacity *= math.sqrt(before / (det + 1e-6) + 1e-6) if draws else 0
        mid = (a + c) / 2
        radius = math.ceil(3 * math.sqrt(mid + math.sqrt(max(0.1, mid * mid - det))))
        low = [min(grid[k], max(0, int((at[k] - radius) / 16))) for k in (0, 1)]
        high = [min(grid[k], max(0, int((at[k] + radius + 15) / 16))) for k in (0, 1)]
        if low[0] >= high[0] or low[1] >= high[1]:
            continue
        color = color_of(inputs.splats, row, view.campos.tolist())
        tau = None if thresholds is None else thresholds[row].item()
        rect = (low[0], low[1], high[0], high[1])
        found.append(
            Splat(row, (at[0], at[1]), (a, b, c), point[2], opacity, color, radius, rect, tau)
        )
    return sorted(found, key=lambda s: s.depth)


def records_at(splats, x, y, offset=(0.0, 0.0), stop=None):
    """The pairs visited at a pixel, in order, and the final transmittance."""
    records, light = [], 1.0
    for s in splats:
        if not (s.rect[0] <= x // 16 < s.rect[2] and s.rect[1] <= y // 16 < s.rect[3]):
            continue
        a, b, c = s.cov
        dx, dy = s.pixel[0] - x - offset[0], s.pixel[1] - y - offset[1]
        q = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)
        g = math.exp(-q / 2)
        alpha = min(0.99, s.opacity * g)
        visible = s.opacity > 0 and q <= 2 * math.log(255 * s.opacity)
        drawn = visible and (s.tau is None or q <= -2 * math.log(s.tau))
        if stop is None and drawn and light * (1 - alpha) < 1e-4:
            break
        if stop is not None and light < stop:
            break
        slope, rim = 0.0, False
        if s.tau is not None:
            soft = 1 / (1 + math.exp(-(g - s.tau) / W))
            rim = visible and q <= -2 * math.log(max(s.tau - 4.6 * W, 1e-4))
            slope = soft * (1 - soft) / W if rim else 0.0
        records.append(Record(s.row, q, alpha, drawn, rim, slope, light, s.color, s.depth))
        if drawn:
            light *= 1 - alpha
    return records, light


def sum_at(records: list[Record], channel) -> float:
    return sum(r.alpha * r.light * channel(r) for r in records if r.drawn)
