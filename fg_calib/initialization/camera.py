"""A pinhole camera with distortion: images of points, and the directions that pixels look in."""

from dataclasses import fields

import numpy as np

from fg_calib.inputs import Floats, InputError, Record, as_floats

MOST_PIXELS = 1e6
"""No camera has more, nor a focal length of more, nor a larger coefficient of distortion."""

NEAREST = 1e-6
"""Depth that a point has at least, [m]: behind the camera there is no image."""


class Camera(Record):
    """A pinhole camera with OpenCV's distortion.

    Attributes:
        fx: Focal length over the width of a pixel.
        fy: The same over its height.
        cx: Column of the principal point, [px].
        cy: Row of the principal point, [px].
        k1: Radial distortion, of the square of the distance from the axis.
        k2: Of its fourth power.
        p1: Tangential distortion.
        p2: The same across.
        k3: Radial distortion, of the sixth power.

    Raises:
        InputError: A figure is none that a camera can have.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            figure = as_floats(f"camera: {f.name}", getattr(self, f.name), "()")
            focal = f.name in ("fx", "fy")
            if not (1.0 <= figure <= MOST_PIXELS if focal else abs(figure) <= MOST_PIXELS):
                expected = f"{'1' if focal else f'{-MOST_PIXELS:g}'} to {MOST_PIXELS:g}{' px' * (f.name[0] in 'fc')}"
                raise InputError(f"camera: {f.name}", f"found {getattr(self, f.name):g}", expected)
            object.__setattr__(self, f.name, float(figure))

    def image(self, points: Floats) -> tuple[Floats, Floats]:
        """Image of points in the camera's frame, shape (n, 2), [px], and its derivative, shape (n, 2, 3).

        x to the right, y down, z ahead. With x, y over z and r their distance from the axis: x (1 + k1 r^2 + k2 r^4 +
        k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and likewise in y with p1 and p2 exchanged.
        """
        z = np.maximum(points[:, 2], NEAREST)
        x, y = points[:, 0] / z, points[:, 1] / z
        s = x * x + y * y
        radial = 1.0 + s * (self.k1 + s * (self.k2 + s * self.k3))
        slope = self.k1 + s * (2.0 * self.k2 + 3.0 * s * self.k3)  # of `radial` in s
        u = self.fx * (x * radial + 2.0 * self.p1 * x * y + self.p2 * (s + 2.0 * x * x)) + self.cx
        v = self.fy * (y * radial + 2.0 * self.p2 * x * y + self.p1 * (s + 2.0 * y * y)) + self.cy
        mixed = 2.0 * x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        J = np.empty((len(points), 2, 3))
        J[:, 0, 0] = self.fx * (radial + 2.0 * x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x)
        J[:, 0, 1], J[:, 1, 0] = self.fx * mixed, self.fy * mixed
        J[:, 1, 1] = self.fy * (radial + 2.0 * y * y * slope + 2.0 * self.p2 * x + 6.0 * self.p1 * y)
        J[:, :, :2] /= z[:, None, None]  # of (x, y) in the point's own coordinates across the axis
        J[:, :, 2] = -(J[:, :, 0] * x[:, None] + J[:, :, 1] * y[:, None])
        J[points[:, 2] < NEAREST] = 0.0
        return np.stack([u, v], axis=1), J
