"""Columns of instruments in a table of configurations, and cameras.

| model | columns |
|---|---|
| `pose position orientation` | `target`: which point of the tool, empty for the tool itself; `station`: seen from |
| `anchor` | `anchor`, `distance`; an empty cell where nothing was measured |
| `plane` | `plane`; `distance`, 0 without |
| `board` | `board`; camera_T_board as a pose, or `rx ry rz` in place of a quaternion; `cov_11 ... cov_66` |
| `pixels` | `u v`, `corner_x corner_y`, `board`; `sigma_pixel`, or `sigma_u sigma_v` |
"""

from __future__ import annotations

import logging
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, create_model

from fg_calib.errors import InputError
from fg_calib.io.columns import Header, Table
from fg_calib.io.table_columns import COVARIANCE
from fg_calib.io.units import Units
from fg_calib.io.yaml import Count, NotNegative, Number, Schema, read_yaml, refuse_unknown_keys, validate
from fg_calib.measurements.checks import covariances
from fg_calib.measurements.dataset import Floats, Labels, Noise
from fg_calib.measurements.kinds import Camera
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Model

_log = logging.getLogger(__name__)

IMAGE = ("u", "v", "corner_x", "corner_y")

_LABELS: dict[str, tuple[str, ...]] = dict.fromkeys(POSE_MODELS, ("target", "station")) | {
    "anchor": ("anchor",),
    "plane": ("plane",),
    "board": ("board",),
    "pixels": ("board",),
}
_EMPTY_MEANS_NONE = ("target", "anchor", "plane")

COLUMNS = {"target", "station", "anchor", "plane", "board", "distance", "sigma_distance", *IMAGE, *COVARIANCE}
COLUMNS |= {"sigma_pixel", "sigma_u", "sigma_v", "rx", "ry", "rz"}
"""Columns that mean something to some model."""


@dataclass(frozen=True)
class InstrumentColumns:
    """The columns of a table that a model reads beside those of every table.

    Attributes:
        labels: Columns of names.
        lengths: Those of distances.
        sigma_length: That of their sigmas.
        image: Those of images of a board's points.
        sigma_pixel: Those of their sigmas.
        covariance: Those of covariances.
    """

    labels: tuple[str, ...]
    lengths: tuple[str, ...]
    sigma_length: tuple[str, ...]
    image: tuple[str, ...]
    sigma_pixel: tuple[str, ...]
    covariance: tuple[str, ...]

    @classmethod
    def of(cls, header: Header, model: Model | None) -> InstrumentColumns:
        """Those that are there; of targets that the model does not know a warning.

        Args:
            header: The table's.
            model: The model; None for those of all models.
        """
        if model in PAIR_MODELS and "target" in header.columns:
            _log.warning("%s: column target is not used: model %s is of one point of the tool", header.name, model)
        every = tuple(dict.fromkeys(name for names in _LABELS.values() for name in names))
        labels = header.present(*(every if model is None else _LABELS.get(model, ())))
        has_lengths = bool({"anchor", "plane"}.intersection(labels)) and model not in PAIR_MODELS
        image = header.group(IMAGE) if model in (None, "pixels") else ()
        return cls(
            labels=labels,
            lengths=header.present("distance") if has_lengths else (),
            sigma_length=header.present("sigma_distance") if has_lengths else (),
            image=image,
            sigma_pixel=header.sigmas("sigma_pixel", ("sigma_u", "sigma_v")) if image else (),
            covariance=header.group(COVARIANCE) if model in (None, "board") else (),
        )

    @property
    def numbers(self) -> tuple[str, ...]:
        """Columns of numbers."""
        return (*self.lengths, *self.sigma_length, *self.image, *self.sigma_pixel, *self.covariance)

    @property
    def several_rows(self) -> bool:
        """Whether a configuration may have several rows: several targets, or corners of a board."""
        return bool(self.image) or bool(set(self.labels) - {"station"})

    def read(self, table: Table, units: Units, noise: Noise) -> dict[str, Any]:
        """What `Measurements` has of them, by the names of its fields.

        Raises:
            InputError: A cell cannot be used.
        """
        length, n = units.factor("m"), table.n_rows
        found: dict[str, Any] = {"labels": {name: _labels(table, name) for name in self.labels}}
        if self.lengths:
            values = table.numbers(self.lengths, optional=True)[:, 0]
            if "plane" not in self.labels:
                table.require(~(values < 0.0), "distance", "a number not below 0")
            found["length"] = values * length
        found["sigma_length"] = None if noise.distance is None else np.full(n, noise.distance)
        if self.sigma_length:
            found["sigma_length"] = table.positive(self.sigma_length, noise.distance, length)[:, 0]
        if self.image:
            found["image"] = table.numbers(self.image) * [1.0, 1.0, length, length]
        found["sigma_pixel"] = None if noise.pixel is None else np.full((n, 2), noise.pixel)
        if self.sigma_pixel:
            found["sigma_pixel"] = np.broadcast_to(table.positive(self.sigma_pixel, noise.pixel, 1.0), (n, 2)).copy()
        if self.covariance:
            found["covariance"] = self._covariance(table, units)
        return found

    def _covariance(self, table: Table, units: Units) -> Floats:
        values = table.numbers(self.covariance)
        C = np.zeros((table.n_rows, 6, 6))
        i, j = np.triu_indices(6)
        C[:, i, j] = C[:, j, i] = values
        size = np.repeat([units.factor("rad"), units.factor("m")], 3)
        good, C = covariances(C * np.outer(size, size))
        table.require(good, self.covariance[0], "a covariance: eigenvalues above 0")
        return C


def _labels(table: Table, column: str) -> Labels:
    """Names in the order met, and which of them each row has."""
    expected = f"the name of a {column}"
    cells: list[str | None] = table.names(
        column, expected + ", or an empty cell" * (column in _EMPTY_MEANS_NONE)
    ).to_list()
    if column not in _EMPTY_MEANS_NONE:
        table.texts(column, expected)
    names = tuple(dict.fromkeys(c for c in cells if c is not None))
    place = {name: i for i, name in enumerate(names)}
    index: NDArray[np.int64] = np.array([-1 if c is None else place[c] for c in cells], dtype=np.int64)
    return Labels(names, index)


_FIGURES: dict[str, Any] = {f.name: (Number, ... if f.default is MISSING else f.default) for f in fields(Camera)}


_Pixels = Annotated[Count, Field(gt=0)]
_Sigmas = Annotated[dict[str, NotNegative], BeforeValidator(refuse_unknown_keys(*_FIGURES))]
_OF_IMAGES: dict[str, Any] = {"width": (_Pixels | None, None), "height": (_Pixels | None, None)}
_OF_IMAGES |= {"sigma": (_Sigmas | None, None)}
"""What a camera's file may say beside its figures: the size of its images, and how well it is known."""

_Camera = create_model("_Camera", __base__=Schema, **_FIGURES, **_OF_IMAGES)


def read_camera(path: Path) -> Camera:
    """A camera's intrinsics: fx, fy, cx, cy in pixels, and the distortion k1 k2 p1 p2 k3 of OpenCV.

    Raises:
        InputError: The file is missing or cannot be used.
    """
    return camera_of(read_yaml(path), path.name)


def read_camera_of_images(path: Path, size: tuple[int, int]) -> Camera:
    """`read_camera` of images of a size.

    Args:
        path: The file.
        size: Width and height of the images, [px].

    Raises:
        InputError: The file cannot be used, or says that it is of images of another size.
    """
    given = read_yaml(path)
    camera = camera_of(given, path.name)
    for name, found in zip(("width", "height"), size, strict=True):
        said = given.get(name)
        if said is not None and said != found:
            hint = "figures of other images would have to be scaled"
            raise InputError(f"{path.name}: {name}", f"found {said}", f"{found} px as the images have", hint)
    for name, most in zip(("cx", "cy"), size, strict=True):
        if not 0.0 <= getattr(camera, name) <= most:
            words = "%s: %s = %g px is outside the images of %d x %d px; is it the camera that took them?"
            _log.warning(words, path.name, name, getattr(camera, name), *size)
    return camera


def camera_of(given: object, place: str) -> Camera:
    """A camera from a mapping.

    Raises:
        InputError: It is no camera.
    """
    file = validate(_Camera, given, place)
    try:
        return Camera(**{f.name: getattr(file, f.name) for f in fields(Camera)})
    except InputError as error:
        raise InputError(error.place.replace("camera", place, 1), error.found, error.expected) from None
