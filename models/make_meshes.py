"""Makes every mesh of models/: `python make_meshes.py` writes meshes/*.obj again, bit for bit.

A file holds all parts of one link that share a colour, in the frame of that link [m]; the colour is in the SDF.
Shapes are lofts (superellipses along an axis), lathes, prisms and tubes; normals are smoothed up to a crease angle.
"""

from pathlib import Path

import numpy as np

MESHES = Path(__file__).parent / "meshes"
CREASE = np.cos(np.deg2rad(38))  # faces that meet at more than this keep a sharp edge


# ---------------------------------------------------------------- shapes: Mesh = (vertices (n, 3), quads (m, 4))


def merge(*meshes):
    """One mesh out of many."""
    offsets = np.cumsum([0] + [len(v) for v, _ in meshes[:-1]])
    return np.vstack([v for v, _ in meshes]), np.vstack([q + o for (_, q), o in zip(meshes, offsets, strict=True)])


def turn(rpy):
    """Rotation matrix of roll, pitch, yaw [deg]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.deg2rad(rpy)), np.sin(np.deg2rad(rpy))
    return np.array([[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                     [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], [-sp, cp * sr, cp * cr]])


def at(mesh, x=0.0, y=0.0, z=0.0, rpy=(0, 0, 0)):
    """The mesh turned by `rpy` [deg], then moved."""
    return mesh[0] @ turn(rpy).T + [x, y, z], mesh[1]


def along(axis, mesh):
    """The mesh with its z axis along `axis` (x, y, z are permuted cyclically)."""
    return mesh[0][:, {"x": [2, 0, 1], "y": [1, 2, 0], "z": [0, 1, 2]}[axis]], mesh[1]


def mirror(axis, mesh):
    """The mesh and its mirror image in the plane across `axis`."""
    flipped = mesh[0].copy()
    flipped[:, "xyz".index(axis)] *= -1
    return merge(mesh, (flipped, mesh[1][:, ::-1]))


def sheet(points, closed=True):
    """Grid (n, m, 3) of points -> its quads; `closed`: the last column joins the first."""
    n, m = points.shape[:2]
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m if closed else m - 1), indexing="ij")
    k = (j + 1) % m
    quads = np.stack([i * m + j, i * m + k, (i + 1) * m + k, (i + 1) * m + j], -1)
    return points.reshape(-1, 3), quads.reshape(-1, 4)


def capped(rings):
    """Closed rings (n, m, 3) stacked along +z, ends closed by fans."""
    ends = [np.repeat(rings[k].mean(0)[None], rings.shape[1], 0) for k in (0, -1)]
    return sheet(np.concatenate([[ends[0]], rings, [ends[1]]]))


def superellipse(a, b, exponent, theta):
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([a * np.sign(c) * abs(c) ** (2 / exponent), b * np.sign(s) * abs(s) ** (2 / exponent)], -1)


def smooth(rows, steps):
    """Catmull-Rom curve through the rows, `steps` points per span."""
    rows = np.asarray(rows, float)
    padded = np.vstack([2 * rows[0] - rows[1], rows, 2 * rows[-1] - rows[-2]])
    out = []
    for p, q, r, s in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        for u in np.arange(steps) / steps:
            cubic = 3 * q - p - 3 * r + s
            out.append(q + u / 2 * (r - p + u * (2 * p - 5 * q + 4 * r - s + u * cubic)))
    return np.array([*out, rows[-1]])


def section(row, theta, offset=0.0):
    z, cx, a, b, exponent = row
    ring = superellipse(a + offset, b + offset, exponent, theta) + [cx, 0]
    return np.column_stack([ring, np.full(len(ring), z)])


def loft(rows, sides=28, steps=2):
    """Body through superellipses: rows (z, centre x, half x, half y, exponent)."""
    theta = np.arange(sides) * 2 * np.pi / sides
    return capped(np.array([section(row, theta) for row in smooth(rows, steps)]))


def patch(rows, z, degrees, offset=0.0025, sides=16, steps=6, rounded=False):
    """A plate on the loft's skin, from z[0] to z[1], from degrees[0] to degrees[1] about its axis."""
    fine = smooth(rows, 12)
    u = np.sin(np.linspace(-1, 1, steps) * np.pi / 2) if rounded else np.linspace(-1, 1, steps)
    levels = np.mean(z) + (z[1] - z[0]) / 2 * u
    cut = np.column_stack([levels] + [np.interp(levels, fine[:, 0], fine[:, k]) for k in range(1, 5)])
    width = (1 - 0.999 * abs(u) ** 3.5) ** (1 / 3.5) if rounded else np.ones(steps)
    middle, half = np.mean(degrees), (degrees[1] - degrees[0]) / 2
    theta = np.deg2rad(middle + np.outer(width, np.linspace(-half, half, sides)))
    skin = np.array([section(row, t, offset) for row, t in zip(cut, theta, strict=True)])
    under = np.array([section(row, t, -0.002) for row, t in zip(cut, theta, strict=True)])
    skin = np.concatenate([under[:1], skin, under[-1:]])
    left = np.concatenate([under[:1, :1], under[:, :1], under[-1:, :1]])
    right = np.concatenate([under[:1, -1:], under[:, -1:], under[-1:, -1:]])
    return sheet(np.concatenate([left, skin, right], axis=1), closed=False)


def lathe(profile, sides=0):
    """Body of revolution about z: profile rows (z, radius); z rises along it for a solid."""
    sides = sides or 10 + int(160 * max(r for _, r in profile))  # more sides for a larger radius
    theta = np.arange(sides) * 2 * np.pi / sides
    return capped(np.array([[[r * np.cos(t), r * np.sin(t), z] for t in theta] for z, r in profile]))


def drum(radius, z0, z1, bevel=0.003, sides=0):
    """Cylinder with bevelled rims."""
    return lathe([(z0, radius - bevel), (z0 + bevel, radius), (z1 - bevel, radius), (z1, radius - bevel)], sides)


def ring(radius, thickness, sides=32, facets=8):
    """Torus about z."""
    phi = np.arange(facets + 1) * 2 * np.pi / facets
    theta = np.arange(sides) * 2 * np.pi / sides
    rows = [[[(radius + thickness * np.cos(p)) * np.cos(t), (radius + thickness * np.cos(p)) * np.sin(t),
              thickness * np.sin(p)] for t in theta] for p in phi]
    return sheet(np.array(rows))


def rectangle(x, y, radius=0.0, corner=4):
    """Outline of a rounded rectangle of full size x by y, counter-clockwise."""
    if radius == 0:
        return np.array([[x, y], [-x, y], [-x, -y], [x, -y]]) / 2
    arc = np.deg2rad(np.linspace(0, 90, corner))
    centres = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [x / 2 - radius, y / 2 - radius]
    return np.vstack([c + radius * np.column_stack([np.cos(arc + k * np.pi / 2), np.sin(arc + k * np.pi / 2)])
                      for k, c in enumerate(centres)])


def stadium(radius, x0, x1, half=11):
    """Outline with round ends about (x0, 0) and (x1, 0)."""
    arc = np.deg2rad(np.linspace(-90, 90, half))
    cap = radius * np.column_stack([np.cos(arc), np.sin(arc)])
    return np.vstack([cap + [x1, 0], -cap + [x0, 0]])


def inset(outline, distance):
    """The outline moved inwards."""
    edge = np.roll(outline, -1, 0) - outline
    normal = np.column_stack([edge[:, 1], -edge[:, 0]])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    before = np.roll(normal, 1, 0)
    mean = normal + before
    return outline - distance * mean / np.maximum(1e-9, (mean * normal).sum(1))[:, None]


def prism(outline, z0, z1, bevel=0.002):
    """The outline (counter-clockwise, star-shaped about its mean) extruded along z."""
    if bevel:
        rings = [(inset(outline, bevel), z0), (outline, z0 + bevel), (outline, z1 - bevel), (inset(outline, bevel), z1)]
    else:
        rings = [(outline, z0), (outline, z1)]
    return capped(np.array([np.column_stack([o, np.full(len(o), z)]) for o, z in rings]))


def block(x, y, z, bevel=0.0):
    """Box by its limits (x0, x1), (y0, y1), (z0, z1)."""
    outline = rectangle(x[1] - x[0], y[1] - y[0]) + [(x[0] + x[1]) / 2, (y[0] + y[1]) / 2]
    return prism(outline, z[0], z[1], bevel)


def band(r0, r1, degrees, z0, z1, steps=24):
    """Sector of an annulus with thickness."""
    t = np.deg2rad(np.linspace(*degrees, steps))
    corner = [(r0, z0), (r1, z0), (r1, z1), (r0, z1)]
    rings = np.array([[[r * np.cos(a), r * np.sin(a), z] for r, z in corner] for a in t])
    return capped(rings[::-1])


def decal(outline, z=0.001):
    """The outline as a flat face towards +z: paint, not a body."""
    rings = np.array([outline, np.repeat(outline.mean(0)[None], len(outline), 0)])
    return sheet(np.concatenate([rings, np.full((*rings.shape[:2], 1), z)], axis=2))


def painted_band(r0, r1, degrees, z=0.001, steps=24):
    """Sector of an annulus as a flat face towards +z."""
    t = np.deg2rad(np.linspace(*degrees, steps))
    return sheet(np.array([[[r * np.cos(a), r * np.sin(a), z] for a in t] for r in (r1, r0)]), closed=False)


def tube(path, radius, sides=10, steps=4):
    """Pipe along a smooth path through the points."""
    line = smooth(path, steps) if len(path) > 2 else np.asarray(path, float)
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.cross(tangent[0], np.eye(3)[np.argmin(abs(tangent[0]))])
    theta = np.arange(sides) * 2 * np.pi / sides
    rings = []
    for p, t in zip(line, tangent, strict=True):
        normal = normal - t * (normal @ t)
        normal /= np.linalg.norm(normal)
        rings.append(p + radius * (np.outer(np.cos(theta), normal) + np.outer(np.sin(theta), np.cross(t, normal))))
    return capped(np.array(rings))


def around(count, radius, mesh, start=0.0):
    """Copies of a mesh on a circle about z."""
    angle = start + np.arange(count) * 360 / count
    return merge(*[at(at(mesh, x=radius), rpy=(0, 0, a)) for a in angle])


LETTERS = {  # strokes (x0, y0, x1, y1) on a grid of 2 by 4
    "E": [(0, 0, 0, 4), (0, 4, 2, 4), (0, 2, 1.6, 2), (0, 0, 2, 0)], "H": [(0, 0, 0, 4), (2, 0, 2, 4), (0, 2, 2, 2)],
    "I": [(1, 0, 1, 4)], "N": [(0, 0, 0, 4), (0, 4, 2, 0), (2, 0, 2, 4)],
    "O": [(0, 0, 2, 0), (2, 0, 2, 4), (2, 4, 0, 4), (0, 4, 0, 0)],
    "P": [(0, 0, 0, 4), (0, 4, 2, 4), (2, 4, 2, 2), (2, 2, 0, 2)],
    "S": [(0, 0, 2, 0), (2, 0, 2, 2), (2, 2, 0, 2), (0, 2, 0, 4), (0, 4, 2, 4)],
    "T": [(1, 0, 1, 4), (0, 4, 2, 4)], "U": [(0, 0, 0, 4), (2, 0, 2, 4), (0, 0, 2, 0)],
    "V": [(0, 4, 1, 0), (1, 0, 2, 4)], "X": [(0, 0, 2, 4), (0, 4, 2, 0)],
    "1": [(1, 0, 1, 4), (1, 4, 0.4, 3.3)], "7": [(0, 4, 2, 4), (2, 4, 0.7, 0)], "-": [(0.3, 2, 1.7, 2)],
}


def text(word, height, z=0.001):
    """Painted letters in the x-y plane, centred, facing +z."""
    u, parts = height / 4.7, []
    for k, letter in enumerate(word):
        for x0, y0, x1, y1 in LETTERS[letter]:
            length, angle = np.hypot(x1 - x0, y1 - y0) * u, np.rad2deg(np.arctan2(y1 - y0, x1 - x0))
            stroke = decal(rectangle(length + 0.7 * u, 0.7 * u), z)
            x = ((x0 + x1) / 2 + 3.3 * (k - (len(word) - 1) / 2) - 1) * u
            parts.append(at(stroke, x, ((y0 + y1) / 2 - 2) * u, 0, (0, 0, angle)))
    return merge(*parts)


# ---------------------------------------------------------------- the robot: part -> {colour: mesh}


def base():
    body = [(0.072, 0, 0.256, 0.216, 2.6), (0.085, 0, 0.268, 0.226, 2.6), (0.13, 0, 0.274, 0.230, 2.6),
            (0.19, 0, 0.272, 0.228, 2.6), (0.228, 0, 0.258, 0.214, 2.5), (0.252, -0.002, 0.222, 0.184, 2.4),
            (0.272, -0.006, 0.172, 0.148, 2.2), (0.300, -0.010, 0.130, 0.118, 2.1), (0.345, -0.010, 0.106, 0.102, 2),
            (0.41, -0.006, 0.092, 0.092, 2), (0.50, 0, 0.084, 0.084, 2), (0.515, 0, 0.080, 0.080, 2)]
    skirt = [(0.056, 0, 0.240, 0.200, 2.6), (0.064, 0, 0.262, 0.220, 2.6), (0.090, 0, 0.272, 0.229, 2.6),
             (0.098, 0, 0.266, 0.224, 2.6)]
    fender = along("y", band(0.106, 0.124, (-104, 104), 0.205, 0.277))
    tyre = along("y", lathe([(0.231, 0.070), (0.232, 0.092), (0.238, 0.099), (0.247, 0.1), (0.248, 0.096),
                             (0.257, 0.096), (0.258, 0.1), (0.267, 0.099), (0.273, 0.092), (0.274, 0.070)], 40))
    rim = along("y", lathe([(0.240, 0.071), (0.274, 0.071), (0.275, 0.066), (0.266, 0.060), (0.264, 0.022)], 40))
    spokes = along("y", around(5, 0.042, prism(rectangle(0.044, 0.011, 0.004), 0.262, 0.2695)))
    caster = along("y", lathe([(-0.013, 0.030), (-0.010, 0.037), (-0.004, 0.040), (0.004, 0.040), (0.010, 0.037),
                               (0.013, 0.030)], 24))
    cheeks = mirror("y", block((-0.014, 0.014), (0.0145, 0.0195), (-0.008, 0.05), 0.002))
    vents = [patch(body, (z, z + 0.007), (150, 210), 0.001, 10, 3) for z in (0.352, 0.370, 0.388)]
    ends = (-0.205, 0.205)
    return {
        "shell": loft(body, 40),
        "graphite": merge(loft(skirt, 40, 1), mirror("y", at(fender, z=0.1)), *[at(cheeks, x, 0, 0.04) for x in ends],
                          drum(0.068, 0.50, 0.70),
                          lathe([(0.655, 0.068), (0.690, 0.088), (0.740, 0.090), (0.748, 0.086)])),
        "dark": merge(mirror("y", at(tyre, z=0.1)), *[at(caster, x, 0, 0.04) for x in ends],
                      patch(body, (0.128, 0.168), (-58, 58), 0.0015), *vents),
        "steel": merge(mirror("y", at(merge(rim, spokes), z=0.1)), drum(0.070, 0.570, 0.578),
                       drum(0.070, 0.610, 0.618)),
        "accent": merge(patch(body, (0.204, 0.213), (0, 360), 0.0015, 41, 2), drum(0.0815, 0.513, 0.521, 0.002),
                        mirror("y", at(along("y", drum(0.019, 0.262, 0.2745)), z=0.1))),
    }


def chest():
    torso = [(0.060, 0, 0.070, 0.080, 2.2), (0.075, 0, 0.082, 0.096, 2.3), (0.12, 0.002, 0.095, 0.113, 2.5),
             (0.20, 0.008, 0.109, 0.130, 2.7), (0.28, 0.010, 0.116, 0.138, 2.8), (0.345, 0.007, 0.114, 0.139, 2.8),
             (0.405, -0.003, 0.105, 0.131, 2.7), (0.445, -0.014, 0.088, 0.110, 2.5), (0.470, -0.024, 0.068, 0.079, 2.2),
             (0.482, -0.030, 0.052, 0.054, 2)]
    joint = along("y", lathe([(0.095, 0.070), (0.132, 0.070), (0.136, 0.066), (0.138, 0.060), (0.146, 0.060)]))
    cover = along("y", lathe([(0.118, 0.0705), (0.119, 0.0725), (0.127, 0.0725), (0.128, 0.0705)]))
    pack = at(prism(rectangle(0.24, 0.17, 0.035), 0, 0.065, 0.012), -0.10, 0, 0.265, (0, -90, 0))
    slots = [block((-0.1665, -0.15), (-0.055, 0.055), (z, z + 0.007)) for z in (0.19, 0.208, 0.226, 0.244)]
    handle = tube([(-0.16, -0.05, 0.34), (-0.182, -0.046, 0.343), (-0.182, 0.046, 0.343), (-0.16, 0.05, 0.34)], 0.007)
    lamp = at(along("x", ring(0.023, 0.0035, 28)), 0.1275, 0, 0.325)
    bellows = [(0.0, 0.086), (0.004, 0.090), (0.018, 0.090), (0.022, 0.074)]
    for z in (0.022, 0.036, 0.050):
        bellows += [(z + 0.003, 0.070), (z + 0.008, 0.075), (z + 0.011, 0.075)]
    return {
        "shell": loft(torso, 40),
        "graphite": merge(lathe([*bellows, (0.066, 0.066)]), mirror("y", at(joint, z=0.30)), pack, handle,
                          at(drum(0.055, 0.472, 0.500, 0.004), -0.03),
                          patch(torso, (0.150, 0.410), (-44, 44), 0.003, 16, 16, True)),
        "dark": merge(*slots, at(along("x", drum(0.0195, 0.118, 0.1285)), z=0.325)),
        "accent": merge(lamp, mirror("y", at(cover, z=0.30)), patch(torso, (0.100, 0.106), (0, 360), 0.0015, 41, 2)),
    }


def neck():
    post = [(-0.021, 0.046), (-0.018, 0.048), (0.006, 0.048), (0.012, 0.043), (0.020, 0.042), (0.024, 0.036),
            (0.028, 0.042), (0.038, 0.042), (0.042, 0.036), (0.046, 0.042), (0.060, 0.042)]
    yoke = mirror("y", along("y", prism(stadium(0.020, -0.035, 0.0), 0.030, 0.038)))
    return {
        "graphite": merge(lathe(post),
                          at(yoke, z=0.09), at(along("y", drum(0.022, -0.045, 0.045)), z=0.09)),
        "accent": drum(0.0495, -0.004, 0.0015, 0.0015),
    }


def head():
    skull = [(-0.014, -0.034, 0.034, 0.046, 2.3), (-0.004, -0.035, 0.050, 0.068, 2.5),
             (0.016, -0.036, 0.059, 0.088, 2.8), (0.055, -0.037, 0.063, 0.100, 3), (0.095, -0.039, 0.061, 0.097, 3),
             (0.122, -0.043, 0.050, 0.082, 2.7), (0.138, -0.047, 0.030, 0.055, 2.3), (0.143, -0.048, 0.006, 0.012, 2)]
    barrel = along("x", lathe([(0.0, 0.028), (0.036, 0.028), (0.040, 0.026), (0.046, 0.0255), (0.046, 0.021),
                               (0.038, 0.018)]))
    glass = along("x", lathe([(0.030, 0.0195), (0.037, 0.0185), (0.040, 0.010), (0.0405, 0.004)], 24))
    stripe = along("x", lathe([(0.027, 0.0280), (0.028, 0.0292), (0.033, 0.0292), (0.034, 0.0280)]))
    ear = at(along("y", merge(drum(0.034, 0.090, 0.106, 0.004), drum(0.020, 0.104, 0.109, 0.002))), -0.037, 0, 0.058)

    def eyes(mesh):
        return mirror("y", at(mesh, y=0.06, z=0.06))

    return {
        "shell": loft(skull, 36),
        "graphite": merge(eyes(barrel), mirror("y", ear)),
        "dark": patch(skull, (0.018, 0.102), (-82, 82), 0.003, 24, 12, True),
        "glass": eyes(glass),
        "accent": merge(eyes(stripe), patch(skull, (0.1085, 0.1125), (-30, 30), 0.002, 20, 2)),
    }


def shoulder():
    """Left; the right one is this turned half a turn about x."""
    dome = [(0.054 * np.sin(a), 0.054 * np.cos(a)) for a in np.deg2rad(np.linspace(-25, 88, 9))]
    return {
        "shell": along("y", lathe([(-0.052, 0.056), (-0.049, 0.061), (-0.034, 0.061), (-0.026, 0.056), *dome])),
        "graphite": merge(drum(0.040, -0.0615, 0.0615), along("y", drum(0.058, -0.0535, -0.051, 0.001))),
    }


def upper_arm():
    plates = mirror("z", prism(stadium(0.046, 0.0, 0.085), 0.0625, 0.078, 0.005))
    tube_ = along("x", loft([(0.063, 0, 0.036, 0.072, 3.5), (0.072, 0, 0.043, 0.077, 3.5), (0.10, 0, 0.048, 0.074, 3),
                             (0.14, 0, 0.050, 0.064, 2.6), (0.20, 0, 0.048, 0.053, 2.3), (0.27, 0, 0.043, 0.046, 2.2),
                             (0.302, 0, 0.040, 0.042, 2.2), (0.310, 0, 0.034, 0.036, 2.2)], 32))
    elbow = at(merge(drum(0.040, -0.0475, 0.0475), along("x", loft([(-0.055, 0, 0.033, 0.036, 2.4),
                                                                   (0, 0, 0.033, 0.036, 2.4)], 24, 1))), 0.36)
    return {
        "shell": merge(plates, tube_),
        "graphite": merge(mirror("z", drum(0.036, 0.074, 0.083, 0.003)), elbow),
        "accent": merge(mirror("z", drum(0.024, 0.080, 0.085, 0.002)),
                        along("x", loft([(0.270, 0, 0.0445, 0.0475, 2.2), (0.278, 0, 0.0437, 0.0467, 2.2)], 32, 1))),
    }


def forearm():
    plates = mirror("z", prism(stadium(0.042, 0.0, 0.070), 0.0485, 0.062, 0.0045))
    tube_ = along("x", loft([(0.054, 0, 0.031, 0.058, 3.5), (0.062, 0, 0.039, 0.062, 3.5), (0.09, 0, 0.045, 0.059, 3),
                             (0.13, 0, 0.046, 0.051, 2.6), (0.19, 0, 0.041, 0.044, 2.2), (0.230, 0, 0.037, 0.0385, 2),
                             (0.240, 0, 0.034, 0.035, 2)], 32))
    return {
        "shell": merge(plates, tube_),
        "graphite": merge(mirror("z", drum(0.032, 0.058, 0.067, 0.003)), along("x", drum(0.033, 0.236, 0.244, 0.001))),
        "accent": merge(mirror("z", drum(0.021, 0.064, 0.069, 0.002)),
                        along("x", loft([(0.205, 0, 0.0405, 0.0429, 2.1), (0.212, 0, 0.0398, 0.0422, 2.1)], 32, 1))),
    }


def wrist_1():
    plates = mirror("z", prism(stadium(0.031, -0.062, 0.0), 0.0365, 0.047, 0.003))
    roll = along("x", lathe([(-0.096, 0.034), (-0.093, 0.037), (-0.072, 0.037), (-0.066, 0.041), (-0.048, 0.040),
                             (-0.044, 0.034)]))
    return {"graphite": merge(roll, plates), "steel": mirror("z", drum(0.022, 0.044, 0.0495, 0.002))}


def wrist_2():
    return {"shell": merge(drum(0.0315, -0.036, 0.036, 0.004), along("x", drum(0.0265, 0.015, 0.0455)))}


def wrist_3():
    bolts = around(6, 0.030, drum(0.0026, 0.0815, 0.0835, 0.0005, 8), 30)
    return {
        "graphite": along("x", lathe([(0.046, 0.024), (0.048, 0.031), (0.052, 0.034), (0.074, 0.034), (0.079, 0.030)])),
        "steel": along("x", merge(drum(0.0355, 0.082, 0.099, 0.002), drum(0.030, 0.076, 0.084), at(bolts, z=0.017))),
        "accent": along("x", drum(0.0362, 0.0885, 0.0915, 0.0008)),
    }


def hand():
    palm = [(0.006, 0, 0.026, 0.034, 2.5), (0.012, 0, 0.029, 0.046, 3), (0.022, 0, 0.030, 0.060, 4),
            (0.040, 0, 0.030, 0.0665, 5), (0.046, 0, 0.028, 0.0645, 5)]
    return {
        "shell": loft(palm, 28),
        "graphite": prism(rectangle(0.054, 0.128, 0.008), 0.044, 0.053, 0.002),
        "dark": mirror("x", block((0.007, 0.013), (-0.062, 0.062), (0.052, 0.055))),
        "steel": merge(drum(0.0345, 0.0015, 0.008, 0.0015), block((-0.004, 0.004), (-0.060, 0.060), (0.052, 0.0545))),
        "accent": patch(palm, (0.0235, 0.0275), (0, 360), 0.001, 29, 2),
    }


def finger():
    """The first; the second is this turned half a turn about z."""
    side = [(0.0035, -0.084), (0.036, -0.084), (0.036, -0.070), (0.031, -0.062), (0.024, -0.048), (0.0195, -0.010),
            (0.0165, 0.010), (0.0145, 0.0145), (0.0095, 0.0145), (0.0085, 0.010), (0.0085, -0.016), (0.0115, -0.048),
            (0.0035, -0.066)]
    cuts = [block((-0.0152, 0.0152), (0.0004, 0.0016), (z, z + 0.0035)) for z in (-0.0115, -0.0055, 0.002, 0.008)]
    return {
        "graphite": along("x", prism(np.array(side), -0.011, 0.011, 0.0012)),
        "dark": merge(block((-0.015, 0.015), (0.0012, 0.0088), (-0.012, 0.012), 0.0008), *cuts),
        "accent": block((-0.0115, 0.0115), (0.0205, 0.0245), (-0.047, -0.042)),
    }


def wrist_camera():
    """In the camera's own frame: the lens ends just behind its origin."""
    return {
        "graphite": merge(prism(rectangle(0.030, 0.026, 0.005), -0.036, -0.010, 0.002),
                          lathe([(-0.012, 0.0115), (-0.004, 0.0115), (-0.002, 0.0105), (-0.002, 0.0085),
                                 (-0.005, 0.007)], 24)),
        "glass": lathe([(-0.008, 0.0080), (-0.0050, 0.0072), (-0.0040, 0.0035)], 16),
        "accent": drum(0.0122, -0.010, -0.0075, 0.0008, 24),
    }


def wrist_camera_bracket():
    """From the sensor's tool side to the camera; left (+x of the hand), the right one turned half a turn about z."""
    back = at(block((-0.0165, -0.0135), (-0.011, 0.011), (-0.036, 0.003)), 0.075, 0, 0.010, (0, -30, 0))
    return {"steel": merge(back, block((0.026, 0.0635), (-0.011, 0.011), (0.0015, 0.0050)))}


# ---------------------------------------------------------------- the valve, in V: x right, y down, z into the panel


def facing(parts):
    """Parts modelled with y up and z towards the viewer, brought into V."""
    return {colour: at(mesh, rpy=(180, 0, 0)) for colour, mesh in parts.items()}


def hexagon(radius):
    a = np.arange(6) * np.pi / 3
    return radius * np.column_stack([np.cos(a), np.sin(a)])


def panel():
    head = decal(np.array([(0.0, -0.013), (0.026, 0.0), (0.0, 0.013)]))
    opens = merge(painted_band(0.279, 0.285, (97, 140)), at(at(at(head, rpy=(0, 0, 90)), 0.282), rpy=(0, 0, 140)))
    ticks = merge(around(36, 0.2150, decal(rectangle(0.014, 0.0028), 0.002)),
                  around(12, 0.2200, decal(rectangle(0.024, 0.0050), 0.002)))
    screws = [(x, y) for x in (-0.385, 0, 0.385) for y in (-0.385, 0, 0.385) if (x, y) != (0, 0)]
    slots = [at(decal(rectangle(0.015, 0.002), 0.0080), x, y, 0, (0, 0, 40 * k)) for k, (x, y) in enumerate(screws)]
    rim = merge(mirror("x", block((0.370, 0.398), (-0.370, 0.370), (0, 0.004), 0.0015)),
                mirror("y", block((-0.398, 0.398), (0.370, 0.398), (0, 0.004), 0.0015)))
    gland = merge(drum(0.052, 0, 0.010), drum(0.034, 0.010, 0.026),
                  around(6, 0.043, prism(hexagon(0.006), 0.009, 0.015, 0.001)))
    gauge = merge(drum(0.056, 0, 0.030, 0.004), drum(0.020, 0.028, 0.0325))
    needle = merge(prism(rectangle(0.044, 0.0035), 0.0330, 0.0345, 0), drum(0.006, 0.0325, 0.0365, 0.001, 16))
    scale = around(9, 0.037, decal(rectangle(0.009, 0.003), 0.0332), 30)
    plate = prism(rectangle(0.15, 0.055, 0.006), 0, 0.0015, 0.0005)
    pipe = [drum(0.028, -0.47, 0.47, 0.001, 24), drum(0.034, -0.09, 0.09, 0.008, 24)]
    for radius, z, half in ((0.055, 0.460, 0.010), (0.046, 0.10, 0.008)):
        pipe.append(mirror("z", drum(radius, z - half, z + half, 0.002, 28)))
    return facing({
        "enamel": prism(rectangle(0.8, 0.8, 0.006), -0.02, 0, 0.002),
        "light": merge(painted_band(0.204, 0.248, (0, 360), steps=61), at(plate, -0.275, -0.300),
                       at(drum(0.048, 0.030, 0.0322, 0.001), 0.285, -0.285)),
        "dark": merge(ticks, mirror("x", opens), *slots, at(text("OPEN", 0.040), -0.265, 0.275),
                      at(text("SHUT", 0.040), 0.265, 0.275), at(text("V-17", 0.036), -0.275, -0.300, 0.0015),
                      at(merge(at(needle, rpy=(0, 0, 130)), scale), 0.285, -0.285)),
        "steel": merge(rim, gland, *[at(drum(0.010, 0.003, 0.0074, 0.001, 16), x, y) for x, y in screws],
                       at(gauge, 0.285, -0.285)),
        "pipe": at(along("x", merge(*pipe)), z=-0.055),
        "mount": mirror("y", block((-0.035, 0.035), (0.23, 0.29), (-0.145, -0.018))),
    })


def wheel():
    grip = block((0.1115, 0.1785), (-0.0125, 0.0125), (0.0775, 0.1025), 0.0015)
    bar = merge(block((-0.1115, 0.1115), (-0.0125, 0.0125), (0.0775, 0.1025), 0.0015),
                mirror("x", block((0.1785, 0.180), (-0.0105, 0.0105), (0.0795, 0.1005))))
    return facing({
        "steel": merge(drum(0.0155, 0.005, 0.075), drum(0.024, 0.026, 0.046), bar),
        "dark": merge(mirror("x", grip),
                      lathe([(0.1175, 0.060), (0.119, 0.0715), (0.1235, 0.0735), (0.125, 0.0735)], 40)),
        "hub": lathe([(0.056, 0.038), (0.060, 0.047), (0.070, 0.054), (0.076, 0.0575), (0.106, 0.0585), (0.116, 0.0555),
                      (0.1195, 0.054)], 40),
        "face": drum(0.0745, 0.1235, 0.130, 0.001, 48),
    })


# ---------------------------------------------------------------- the laboratory, in W; walls at x -6, 4.5 and y +-5.4


def opposite(mesh):
    """The mesh turned by half a turn about z: from the wall y = 5.4 to the wall y = -5.4."""
    return at(mesh, rpy=(0, 0, 180))


def cabinet(x, width, height, doors):
    """A row of doors that face -y, its back at y = 5.38."""
    yield "dark", block((x + 0.02, x + width - 0.02), (4.97, 5.38), (0, 0.08))
    for u in x + width / doors * np.arange(doors):
        end = u + width / doors
        yield "white", block((u, end - 0.012), (4.93, 5.38), (0.08, height))
        yield "dark", block((end - 0.07, end - 0.05), (4.90, 4.93), (height * 0.45, height * 0.45 + 0.16))


def furniture():
    yield from cabinet(2.2, 1.2, 2.0, 2)
    for x, width, height, doors in ((-4.2, 1.6, 2.0, 3), (-1.2, 3.6, 0.9, 6), (2.8, 1.6, 2.0, 3)):
        for colour, mesh in cabinet(x, width, height, doors):
            yield colour, opposite(mesh)
    yield "wood", opposite(block((-1.22, 2.42), (4.90, 5.38), (0.90, 0.93)))
    yield "white", opposite(block((-0.8, 1.6), (5.36, 5.39), (1.15, 2.1)))  # whiteboard and its frame
    yield "steel", opposite(block((-0.84, 1.64), (5.37, 5.395), (1.11, 2.14)))
    # workbench: screen, keyboard, vice, a board of tools
    yield "wood", block((-2.2, 0.6), (4.65, 5.38), (0.86, 0.91))
    for x in (-2.15, -0.85, 0.49):
        for y in (4.7, 5.28):
            yield "steel", block((x, x + 0.06), (y, y + 0.06), (0, 0.86))
    yield "steel", block((-2.1, 0.5), (4.75, 5.33), (0.20, 0.23))
    yield "steel", block((-2.0, 0.4), (5.36, 5.385), (1.15, 1.95))
    yield "dark", block((-1.75, -1.15), (5.14, 5.17), (1.02, 1.38))
    yield "blue", block((-1.72, -1.18), (5.135, 5.14), (1.05, 1.35))
    yield "dark", block((-1.50, -1.40), (5.15, 5.20), (0.92, 1.1))
    yield "dark", block((-1.6, -1.3), (5.05, 5.25), (0.91, 0.925))
    yield "dark", block((-1.72, -1.22), (4.80, 4.95), (0.91, 0.928))
    yield "blue", block((0.30, 0.42), (4.68, 4.86), (0.91, 1.03))
    yield "blue", block((0.27, 0.45), (4.66, 4.70), (0.98, 1.06))
    for k, x in enumerate(np.arange(-0.9, 0.3, 0.17)):
        yield "dark", block((x, x + 0.03), (5.34, 5.36), (1.55 - 0.1 * (k % 3), 1.82))


def shelf():
    for y in (0.9, 2.5):
        for x in (4.0, 4.42):
            yield "steel", block((x, x + 0.04), (y, y + 0.04), (0, 1.9))
    boxes = {0.15: ((1.0, 0.5, 0.35), (1.6, 0.4, 0.3), (2.08, 0.36, 0.4)), 0.7: ((1.02, 0.36, 0.28), (1.5, 0.6, 0.36)),
             1.25: ((1.05, 0.6, 0.3), (1.8, 0.3, 0.36), (2.15, 0.28, 0.2)), 1.8: ((1.2, 0.45, 0.24), (1.8, 0.5, 0.3))}
    colours = iter(("blue", "paper", "white", "paper", "blue", "paper", "white", "paper", "blue", "paper"))
    for z, row in boxes.items():
        yield "wood", block((3.99, 4.47), (0.89, 2.55), (z, z + 0.03))
        for y, width, height in row:
            yield next(colours), block((4.04, 4.40), (y, y + width), (z + 0.03, z + 0.03 + height))


def door_and_windows():
    yield "blue", block((4.46, 4.49), (-3.4, -2.45), (0, 2.08))
    for y, z in (((-3.46, -3.4), (0, 2.14)), ((-2.45, -2.39), (0, 2.14)), ((-3.46, -2.39), (2.08, 2.14))):
        yield "steel", block((4.44, 4.5), y, z)
    yield "steel", block((4.41, 4.46), (-2.62, -2.5), (1.02, 1.05))
    yield "exit_sign_and_plant", block((4.45, 4.49), (-3.15, -2.70), (2.24, 2.42))
    yield "white", at(text("EXIT", 0.11), 4.449, -2.925, 2.33, (90, 0, -90))
    for y in (-3.6, -0.8, 2.0):
        yield "windows", block((-5.99, -5.96), (y, y + 1.6), (1.0, 2.4))
        for z in ((0.93, 1.0), (2.4, 2.46)):
            yield "white", block((-6, -5.94), (y - 0.06, y + 1.66), z)
        for u in (y - 0.06, y + 0.77, y + 1.6):
            yield "white", block((-6, -5.94), (u, u + 0.06), (1.0, 2.4))


def pipework():
    """Pipes on the wall behind the valve, another hand wheel on one of them."""
    for x, z, radius in ((4.32, 2.75, 0.07), (4.36, 2.95, 0.045)):
        yield "pipes", tube([(x, -5.3, z), (x, 5.3, z)], radius, 12)
    for y in (-0.9, 3.1):
        yield "pipes", tube([(4.32, y, 2.75), (4.32, y, 0.0)], 0.055, 12)
        for z in (0.3, 0.88, 1.32, 2.2):
            yield "pipes", at(drum(0.095, -0.02, 0.02, 0.003, 16), 4.32, y, z)
    yield "pipes", at(along("x", drum(0.03, -0.16, 0.0, 0.003, 12)), 4.28, -0.9, 1.1)
    spokes = around(3, 0.07, block((-0.07, 0.07), (-0.010, 0.010), (-0.007, 0.007)))
    wheel = merge(ring(0.145, 0.014, 24, 6), spokes, drum(0.03, -0.02, 0.02, 0.004, 16))
    yield "hand_wheel", at(along("x", wheel), 4.11, -0.9, 1.1)


def trim():
    """Lane lines and skirting on the floor, beams with lamps."""
    for y in (-2.6, 2.6):
        yield "paper", block((-4.8, 2.2), (y - 0.03, y + 0.03), (0.0, 0.002))
    for x in (-4.8, 2.2):
        yield "paper", block((x - 0.03, x + 0.03), (-2.6, 2.6), (0.0, 0.002))
    for y in (-5.4, 5.38):
        yield "steel", block((-6, 4.5), (y, y + 0.02), (0, 0.1))
    yield "steel", block((4.48, 4.5), (-5.4, 5.4), (0, 0.1))
    for x in (-3.6, 0.9):
        yield "steel", block((x, x + 0.12), (-5.4, 5.4), (3.36, 3.5))
        for y in (-3.6, -0.75, 2.1):
            yield "lamps", block((x - 0.10, x + 0.22), (y, y + 1.5), (3.24, 3.30))


def decoys():
    """Red and green things that are no markers, to be rejected by the segmentation."""
    leaf = lathe([(-0.30, 0.004), (-0.12, 0.055), (0.06, 0.075), (0.22, 0.045), (0.32, 0.003)], 6)
    for k, a in enumerate(np.arange(9) * 0.698):
        lean = (-25 * np.sin(a), 30 * np.cos(a), np.rad2deg(a))
        x, y = 3.95 + 0.2 * np.cos(a), 4.85 + 0.2 * np.sin(a)
        yield "exit_sign_and_plant", at(leaf, x, y, 1.0 + 0.16 * (k % 3), lean)
    yield "dark", at(lathe([(0.0, 0.15), (0.02, 0.16), (0.36, 0.21), (0.40, 0.21)], 20), 3.95, 4.85)
    yield "dark", tube([(3.95, 4.85, 0.38), (3.95, 4.85, 0.9)], 0.02, 6)
    bottle = lathe([(0.0, 0.070), (0.01, 0.078), (0.40, 0.078), (0.45, 0.060), (0.475, 0.025), (0.50, 0.022)], 20)
    hose = tube([(4.33, -1.95, 1.08), (4.24, -1.98, 1.02), (4.25, -2.03, 0.8), (4.27, -2.03, 0.68)], 0.013, 6)
    yield "fire_extinguisher", at(bottle, 4.33, -1.95, 0.55)
    yield "dark", merge(at(drum(0.03, 0.50, 0.55, 0.004, 12), 4.33, -1.95, 0.55), hose)
    yield "tool_box", block((-0.55, 0.0), (4.85, 5.1), (0.91, 1.10), 0.008)
    yield "tool_box", block((-0.52, -0.03), (4.88, 5.07), (1.10, 1.15), 0.012)
    handle = [(-0.42, 4.975, 1.14), (-0.40, 4.975, 1.21), (-0.15, 4.975, 1.21), (-0.13, 4.975, 1.14)]
    yield "dark", tube(handle, 0.012, 6)
    yield "crate", at(block((-0.19, 0.19), (-0.16, 0.16), (0, 0.40), 0.006), 3.75, 0.15, 0.0, (0, 0, 38))
    triangle = np.array([(0.866, -0.5), (0.0, 1.0), (-0.866, -0.5)])
    for colour, size, x in (("warning_sign", 0.24, 4.488), ("white", 0.15, 4.482)):
        yield colour, at(along("x", prism(size * triangle, -0.004, 0.004, 0)), x, 3.95, 1.8)


def laboratory():
    parts = {}
    for group in (furniture, shelf, door_and_windows, pipework, trim, decoys):
        for colour, mesh in group():
            parts.setdefault(colour, []).append(mesh)
    return {colour: merge(*meshes) for colour, meshes in parts.items()}


# ---------------------------------------------------------------- files


def obj(mesh):
    """Wavefront text of a mesh: vertices to 10 um, doubles welded, faces without area dropped."""
    points, index = np.unique(np.round(mesh[0], 5) + 0.0, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh[1]]
    cross = np.cross(points[faces[:, 2]] - points[faces[:, 0]], points[faces[:, 3]] - points[faces[:, 1]])
    keep = np.linalg.norm(cross, axis=1) > 1e-10
    faces, cross = faces[keep], cross[keep]
    unit, index = np.unique(np.round(normals(faces, cross), 2).reshape(-1, 3) + 0.0, axis=0, return_inverse=True)
    lines = ["v " + " ".join(f"{c:.5g}" for c in p) for p in points]
    lines += ["vn " + " ".join(f"{c:.2g}" for c in n) for n in unit]
    for face, normal in zip(faces, index.reshape(-1, 4), strict=True):
        lines.append("f " + " ".join(f"{face[k] + 1}//{normal[k] + 1}" for k in range(4) if face[k] != face[k - 1]))
    return "\n".join(lines) + "\n"


def normals(faces, cross):
    """Unit normals at the corners (m, 4, 3) of faces of area vector `cross` (m, 3): the mean of the neighbours that
    meet at less than the crease angle."""
    flat = cross / np.linalg.norm(cross, axis=1)[:, None]
    order = np.argsort(faces.ravel(), kind="stable")
    start = np.searchsorted(faces.ravel()[order], np.arange(faces.max() + 2))
    out = np.empty((*faces.shape, 3))
    for corner, vertex in enumerate(faces.ravel()):
        near = np.unique(order[start[vertex] : start[vertex + 1]] // 4)
        near = near[flat[near] @ flat[corner // 4] > CREASE]
        out[corner // 4, corner % 4] = cross[near].sum(0)
    return out / np.linalg.norm(out, axis=2)[:, :, None]


PARTS = (base, chest, neck, head, shoulder, upper_arm, forearm, wrist_1, wrist_2, wrist_3, hand, finger, wrist_camera,
         wrist_camera_bracket, panel, wheel, laboratory)


def write(folder):
    """All meshes as <part>_<colour>.obj."""
    folder.mkdir(exist_ok=True)
    for part in PARTS:
        for colour, mesh in part().items():
            (folder / f"{part.__name__}_{colour}.obj").write_text(obj(mesh))


if __name__ == "__main__":
    write(MESHES)
