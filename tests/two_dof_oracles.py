"""NumPy evaluations of the 2-RPR and 2-RRR, typed apart from the library, for its tests to compare with."""

import numpy as np


def local_indices(x, y, la=None, lb=None):
    """1/kappa and 1/|det J| at R = 1 from eqs. (6), (10), (11), (14), (15); lengths where la is None."""
    base = np.array([1.0, -1.0])
    dx, dy = x[..., None] - base, y[..., None] + 0 * base
    length = np.hypot(dx, dy)
    if la is None:
        jx, jq = np.stack([dx, dy], -1), length
    else:
        bend = np.array([1.0, -1.0])
        angle = np.arctan2(dy, dx)
        cosine = (length**2 + la**2 - lb**2) / (2 * la * length)
        phi = angle - bend * np.arccos(np.clip(cosine, -1, 1))  # elbows out
        across, up = dx - la * np.cos(phi), dy - la * np.sin(phi)
        jx = np.stack([across, up], -1)
        jq = -la * (across * np.sin(phi) - up * np.cos(phi))
    j = np.linalg.solve(jx, jq[..., None] * np.eye(2))
    sigma = np.linalg.svd(j, compute_uv=False)
    return sigma[..., 1] / sigma[..., 0], 1 / np.abs(np.linalg.det(j))


def limits(theta, l_min):
    """Eq. (17) at R = 1: least and greatest distance from O along theta."""
    s, c = np.abs(np.sin(theta)), np.cos(theta)
    return s + np.sqrt(l_min**2 - c**2), -s + np.sqrt((l_min + 2) ** 2 - c**2)


def equation_29(l_min, rings, sectors, **links):
    """Eq. (29) by loops: mid-point rings on equal sectors. -> GII, GRI, area"""
    sums = np.zeros(3)
    for k in range(sectors):
        theta = -np.pi / 2 + (k + 0.5) * np.pi / sectors
        inner, outer = limits(theta, l_min)
        edges = np.linspace(inner, outer, rings + 1)
        middle = (edges[1:] + edges[:-1]) / 2
        ring = (edges[1:] ** 2 - edges[:-1] ** 2) / 2 * np.pi / sectors
        isotropy, resistivity = local_indices(-middle * np.sin(theta), middle * np.cos(theta), **links)
        sums += [ring @ isotropy, ring @ resistivity, ring.sum()]
    return sums[0] / sums[2], sums[1] / sums[2], sums[2]


def paper_rule(l_min, **links):
    """The discretization behind the printed tables, as loops. -> GII, GRI, SUI"""
    gii = gri = total = width = 0.0
    for k in range(2, 99):
        theta = -np.pi / 2 + k * np.pi / 100
        inner, outer = limits(theta, l_min)
        radius = inner + np.arange(1, 50) / 50 * (outer - inner)
        isotropy, resistivity = local_indices(-radius * np.sin(theta), radius * np.cos(theta), **links)
        weight = outer**2 - inner**2
        gii, gri, total = gii + weight * isotropy.mean(), gri + weight * resistivity.mean(), total + weight
        width = max(width, abs(outer * np.sin(theta)))
    height = np.sqrt((l_min + 2) ** 2 - 1)
    box = 2 * (width if links else l_min + 1) * height
    return gii / total, gri / total, total / 2 * np.pi / 100 / box


def duffy(l_min, la, lb, count):
    """Area-weighted GII, GRI and the area by Gauss nodes in leg lengths, the y = 0 corner collapsed.

    l_i = l_min + 2 sin^2(z_i / 2), dW = l1 l2 / (2 y) dl1 dl2, half-square pi - z1 = pi r s,
    z2 = pi r (1 - s); a rule of another kind than the library's panels in elbow angles.
    """
    t, w = np.polynomial.legendre.leggauss(count)
    t, w = (t + 1) / 2, w / 2
    r, s = t[:, None], t[None, :]
    a, b = np.pi * r * s, np.pi * r * (1 - s)  # pi - z1 and z2
    l1, l2 = l_min + 2 * np.cos(a / 2) ** 2, l_min + 2 * np.sin(b / 2) ** 2
    e = 2 * (np.sin(a / 2) ** 2 + np.sin(b / 2) ** 2)
    y = np.sqrt(((l1 + l2) ** 2 - 4) * e * (4 - e)) / 4
    measure = 2 * l1 * l2 / (2 * y) * np.sin(a) * np.sin(b) * np.pi**2 * r * w[:, None] * w[None, :]
    isotropy, resistivity = local_indices((l2**2 - l1**2) / 4, y, la, lb)
    area = measure.sum()
    return (measure * isotropy).sum() / area, (measure * resistivity).sum() / area, area
