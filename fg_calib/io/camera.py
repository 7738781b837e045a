"""Cameras: intrinsics in a YAML file, or in a mapping of a job."""

from __future__ import annotations

import logging
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, create_model

from fg_calib.errors import InputError
from fg_calib.io.yaml import Count, NotNegative, Number, Schema, read_yaml, refuse_unknown_keys, validate
from fg_calib.measurements.kinds import Camera

_log = logging.getLogger(__name__)

_INTRINSICS: dict[str, Any] = {f.name: (Number, ... if f.default is MISSING else f.default) for f in fields(Camera)}
_Pixels = Annotated[Count, Field(gt=0)]
_Sigmas = Annotated[dict[str, NotNegative], BeforeValidator(refuse_unknown_keys(*_INTRINSICS))]
_OF_IMAGES: dict[str, Any] = {"width": (_Pixels | None, None), "height": (_Pixels | None, None)}
_OF_IMAGES |= {"sigma": (_Sigmas | None, None)}
"""What a camera's file may say besides its intrinsics: the size of its images, and how well it is known."""

_Camera = create_model("_Camera", __base__=Schema, **_INTRINSICS, **_OF_IMAGES)


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
            hint = "the intrinsics of other images would have to be scaled"
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
