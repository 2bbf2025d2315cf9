# SPDX-License-Identifier: GPL-3.0-or-later
"""A run rendered from its views, one EXR a frame, in a folder that can be gone on with after any stop.

`bake.json` in the folder says what the layers were made from and which frames are whole; it is written
after each frame. A frame is made again unless it is listed there under the same settings.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from ..capture.camera import Camera
from ..errors import RunError
from ..files import inside, read_json, write_json
from ..look import KeyedEdits, LookEdits
from ..progress import Progress
from .exr import write_layers
from .frames import Frame
from .layers import FrameLayers, Rendering, layer_names, layers_of

RECORD = "bake.json"
VERSION = 1


class Renderer(Protocol):
    """A fitted run, as `bake` uses it. `fingerprint` changes whenever its pictures would; elements: names by light."""

    @property
    def fingerprint(self) -> str: ...
    @property
    def lights(self) -> Sequence[str]: ...
    @property
    def elements(self) -> Mapping[str, Sequence[str]]: ...
    def render(self, camera: Camera, edits: LookEdits | None = None) -> Rendering: ...


@dataclass(frozen=True)
class BakeSettings:
    """What the layers are to be.

    width, height: in pixels; without a height the frame's proportions are kept, without either its size.
    half: 16 bit floats. edits: words for `LookEdits.parse`. keyed: more of them, by frame number.
    """

    width: int | None = None
    height: int | None = None
    half: bool = True
    edits: tuple[str, ...] = ()
    keyed: KeyedEdits = field(default_factory=KeyedEdits)

    def scaled(self, camera: Camera) -> Camera:
        """A frame's camera at the size asked for."""
        if not self.width:
            return camera
        return camera.scaled(self.width, self.height or max(round(self.width * camera.height / camera.width), 1))


def bake(renderer: Renderer, frames: Sequence[Frame], cameras: Mapping[str, Camera], out: Path | str,
         settings: BakeSettings | None = None, progress: Progress | None = None, *,
         overwrite: bool = False) -> dict[str, Any]:
    """Write the layers of `frames` (cameras by the view's name) under `out`; returns the content of bake.json.

    Frames that an earlier bake with the same settings finished are left as they are, and stay in the record.
    Raises RunError where `out` holds layers made with other settings, unless `overwrite`; SettingsError for
    edits that make no sense; Cancelled when asked to stop.
    """
    settings, progress, out = settings or BakeSettings(), progress or Progress(), Path(out)
    keyed = settings.keyed.and_always(settings.edits)
    edits = {frame.number: keyed.at(frame.number, renderer.lights, renderer.elements) for frame in frames}
    made_from = {"renderer": renderer.fingerprint, "half": settings.half, "edits": list(keyed.always),
                 "size": [settings.width, settings.height]}
    if keyed.frames:
        made_from["keyed"] = keyed.described()["frames"]
    record = _earlier(out, made_from, overwrite)
    record["layers"] = layer_names(renderer.lights)
    done = {entry["file"] for entry in record["frames"] if (out / entry["file"]).is_file()}
    record["frames"] = [entry for entry in record["frames"] if entry["file"] in done]
    left = [frame for frame in frames if frame.file not in done]
    progress.stage("bake", len(frames), len(frames) - len(left))
    for frame in left:
        camera = settings.scaled(cameras[frame.view])
        layers = _layers(renderer, camera, edits[frame.number])
        write_layers(out / frame.file, layers, half=settings.half,
                     notes={"view": frame.view, "frame": frame.number, **made_from})
        record["frames"].append({"file": frame.file, "frame": frame.number, "view": frame.view,
                                 "width": camera.width, "height": camera.height})
        record["frames"].sort(key=lambda entry: (Path(entry["file"]).parent.as_posix(), entry["frame"]))
        write_json(out / RECORD, record)
        progress.advance()
    return record


def _layers(renderer: Renderer, camera: Camera, edits: LookEdits) -> FrameLayers:
    """One frame. The colour of whole lights is applied to the finished layers, which is exact for any blend."""
    colours = edits.matrices(renderer.lights)
    if edits.colour_of_lights_only:
        return layers_of(renderer.render(camera), colours)
    return layers_of(renderer.render(camera, edits.without_colour_of_lights()), colours)


def _earlier(out: Path, made_from: dict[str, Any], overwrite: bool) -> dict[str, Any]:
    """The record of an earlier bake with the same settings, or a new one."""
    fresh: dict[str, Any] = {"version": VERSION, "made_from": made_from, "layers": {}, "frames": []}
    if not (out / RECORD).exists():
        return fresh
    record = read_record(out)
    if record["made_from"] == made_from:
        return record
    if not overwrite:
        raise RunError(f"{out} holds layers that were baked from another fit or with other settings; "
                       f"choose another folder, or ask for overwriting.")
    for entry in record["frames"]:  # a mixture of two bakes would pass for one sequence
        (out / entry["file"]).unlink(missing_ok=True)
    return fresh


def read_record(out: Path | str) -> dict[str, Any]:
    """bake.json of a folder of layers. Raises RunError where it is missing or damaged."""
    path = Path(out) / RECORD
    record = read_json(path, RunError)
    try:
        for entry in record["frames"]:
            inside(out, entry["file"], RunError)
            int(entry["frame"]), int(entry["width"]), int(entry["height"])
        if record["version"] != VERSION or not isinstance(record["made_from"], dict):
            raise ValueError(f"version {record['version']}")
        dict(record["layers"]).items()
    except (KeyError, TypeError, ValueError) as problem:
        raise RunError(f"{path} is damaged or from another version ({problem!r}); bake into a new folder.") from problem
    return record
