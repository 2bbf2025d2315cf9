# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour spaces of OpenColorIO configurations, by PyOpenColorIO: the package `opencolorio`, or Blender's own."""
from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import EngineError, SettingsError
from ..system.reading import check_regular
from .spaces import REC_709, Chromaticities, ColourSpace, colour_space, linear_space
from .spaces import built_in_names as built_in_names

CONFIGURED_NAMES = {
    "linear": ("lin_rec709_scene", "lin_rec709", "Linear Rec.709 (sRGB)", "Linear Rec.709", "Utility - Linear - sRGB",
               "Utility - Linear - Rec.709", "Linear"),
    "acescg": ("ACEScg", "lin_ap1_scene", "lin_ap1", "ACES - ACEScg"),
    "aces2065-1": ("ACES2065-1", "lin_ap0_scene", "lin_ap0", "ACES - ACES2065-1"),
    "rec2020": ("lin_rec2020_scene", "lin_rec2020", "Linear Rec.2020", "Utility - Linear - Rec.2020"),
    "p3-d65": ("lin_p3d65_scene", "lin_p3d65", "Linear P3-D65", "Linear DCI-P3 D65", "Utility - Linear - P3-D65"),
}
"""Names that configurations use for the built-in linear spaces."""
_BUILT_IN = "ocio://default"
_CAMERA_TRANSFORMS = {
    "logc3": "ARRI_ALEXA-LOGC-EI800-AWG", "logc4": "ARRI_LOGC4", "slog3": "SONY_SLOG3-SGAMUT3",
    "slog3-cine": "SONY_SLOG3-SGAMUT3.CINE", "vlog": "PANASONIC_VLOG-VGAMUT", "log3g10": "RED_LOG3G10-RWG",
    "acescct": "ACEScct", "acescc": "ACEScc", "clog2": "CANON_CLOG2-CGAMUT", "clog3": "CANON_CLOG3-CGAMUT",
    "applelog": "APPLE_LOG"}
"""OpenColorIO's transforms from the cameras' spaces to ACES2065-1."""


def has_configuration() -> bool:
    """Return whether the variable OCIO names a configuration."""
    return bool(os.environ.get("OCIO"))


def ocio_space(name: str, config: Path | str | None) -> ColourSpace:
    """Return the space `name` of an OpenColorIO configuration.

    config: its file, or "ocio://..." for one of the library's own; None for the one that the variable OCIO names, or
    else the library's default. A space that OpenColorIO calls linear is returned as a linear space with a matrix.
    Raises SettingsError for a configuration that cannot be read or lacks the space, EngineError where the library is
    not installed.
    """
    library = _import_library()
    config_path = str(config or os.environ.get("OCIO") or _BUILT_IN)
    check_regular(config_path)
    try:
        configuration = library.Config.CreateFromFile(config_path)
    except Exception as problem:  # PyOpenColorIO's own class, unknown if it is not installed
        raise SettingsError(f"The OpenColorIO configuration {config_path} cannot be read ({_one_line(problem)}); "
                            "choose another file.") from problem
    space = configuration.getColorSpace(name)
    if space is None:
        if name.lower() in built_in_names():
            return colour_space(name)
        raise SettingsError(f"The OpenColorIO configuration {config_path} has no colour space {name!r}; it has "
                            f"{', '.join(list(configuration.getColorSpaceNames())[:12])}, …")
    if configuration.isColorSpaceLinear(name, library.REFERENCE_SPACE_SCENE):
        processor = _get_processor(library, configuration, name, forward=True)
        matrix = _apply_processor(processor, np.eye(3, dtype=np.float32)).T.astype(np.float64)  # columns: primaries
        built_in = _built_in_space(space)
        return linear_space(name, matrix, built_in.chromaticities if built_in else _derive_chromaticities(matrix))
    forward, inverse = (_get_processor(library, configuration, name, forward=is_forward)
                        for is_forward in (True, False))
    return ColourSpace(name, lambda pixels: _apply_processor(forward, pixels),
                       lambda pixels: _apply_processor(inverse, pixels))


def camera_space(name: str) -> ColourSpace:
    """Return the space of a camera's logarithmic curve, by OpenColorIO's own transforms. name: a key of
    _CAMERA_TRANSFORMS. Raises EngineError where OpenColorIO is not installed."""
    library = _import_library()
    transform = library.BuiltinTransform(style=f"{_CAMERA_TRANSFORMS[name]}_to_ACES2065-1")
    config = library.Config.CreateRaw()
    forward, inverse = (config.getProcessor(transform, direction).getDefaultCPUProcessor()
                        for direction in (library.TRANSFORM_DIR_FORWARD, library.TRANSFORM_DIR_INVERSE))
    aces = colour_space("aces2065-1")
    return ColourSpace(name, lambda pixels: aces.to_linear(_apply_processor(forward, pixels)),
                       lambda light: _apply_processor(inverse, aces.from_linear(light)), has_headroom=True)


def _import_library() -> ModuleType:
    """Import PyOpenColorIO: the installed package, else Blender's own, which lies where Python does not search."""
    if importlib.util.find_spec("PyOpenColorIO"):
        return importlib.import_module("PyOpenColorIO")
    blender = sys.modules.get("bpy")
    if blender is not None:
        root = Path(str(blender.utils.system_resource("PYTHON")))
        for path in sorted(root.glob("lib/**/PyOpenColorIO/PyOpenColorIO*")):
            spec = importlib.util.spec_from_file_location("PyOpenColorIO.PyOpenColorIO", path)
            if spec is not None and spec.loader is not None and path.suffix in (".so", ".pyd"):
                module = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(module)
                return module
    raise EngineError("This colour space needs OpenColorIO: install the Python package opencolorio in the engine's "
                      "environment.")


def _get_processor(library: ModuleType, config: Any, name: str, *, forward: bool) -> Any:
    """Return the processor from the space `name` to linear Rec. 709 (`forward`), or back.

    If the configuration has no name for linear Rec. 709, OpenColorIO's built-in space is used for it.
    """
    linear = next((name for name in CONFIGURED_NAMES["linear"] if config.getColorSpace(name) is not None), None)
    try:
        if linear is not None:
            processor = config.getProcessor(name, linear) if forward else config.getProcessor(linear, name)
        elif forward:
            processor = library.Config.GetProcessorToBuiltinColorSpace(config, name, "lin_rec709_scene")
        else:
            processor = library.Config.GetProcessorFromBuiltinColorSpace("lin_rec709_scene", config, name)
        return processor.getDefaultCPUProcessor()
    except Exception as problem:
        raise SettingsError(f"OpenColorIO cannot convert between {name!r} and linear Rec. 709 in this configuration "
                            f"({_one_line(problem)}).") from problem


def _apply_processor(processor: Any, pixels: NDArray[Any]) -> NDArray[np.float32]:
    values = np.array(pixels, np.float32, order="C")
    processor.applyRGB(values.reshape(-1, 3))
    return values


def _built_in_space(space: Any) -> ColourSpace | None:
    """Return ACEScg or ACES2065-1 for a configuration's space that has such a name or alias; None for others."""
    for name in (space.getName(), *space.getAliases()):
        plain = name.lower().replace("aces - ", "").strip()
        if plain in ("acescg", "aces2065-1"):
            return colour_space(plain)
    return None


def _derive_chromaticities(matrix: NDArray[np.float64]) -> Chromaticities:
    """Derive the primaries of a space from its matrix (3, 3) to linear Rec. 709. The white is that of Rec. 709, to
    which the matrix adapts the space's own."""
    from .spaces import matrix_to_xyz

    xyz = matrix_to_xyz(REC_709) @ matrix
    points = [*xyz.T, xyz.sum(1)]  # X, Y, Z of red, green, blue and white
    flat = [float(value) for point in points for value in point[:2] / point.sum()]
    return (flat[0], flat[1], flat[2], flat[3], flat[4], flat[5], flat[6], flat[7])


def _one_line(problem: Exception) -> str:
    return " ".join(str(problem).split())[:200].rstrip(".")
