# SPDX-License-Identifier: GPL-3.0-or-later
"""A run rendered from its views, one EXR a frame, in a folder that can be gone on with after any stop.

A frame is made again unless its file is there and its header names the same settings, so any number of
processes may make frames of one folder. `bake.json` lists what is whole; it is written after each frame.
"""
from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from ..capture.camera import Camera
from ..colour import ColourSpace, colour_space
from ..conventions.frame_numbers import Frame
from ..errors import FrameError, RunError
from ..images.exr import exr_is_cut_off, window_of
from ..look import KeyedEdits, LookEdits
from ..system.files import inside, locked, read_json, remove_file, write_json
from ..system.progress import Progress
from ..typed import value_of
from .exr import read_description, write_layers
from .layers import FrameLayers, Rendering, layer_names, layers_of

RECORD = "bake.json"
LOCK = ".bake.lock"
VERSION = 1


class OfCamera(Protocol):
    """What renders a camera's view, with edits."""

    def render(self, camera: Camera, edits: LookEdits | None = None) -> Rendering: ...


class FrameRenderer(OfCamera, Protocol):
    """What renders one frame. fingerprint: changes whenever this frame's picture would, beyond the whole's; empty
    where nothing is this frame's alone. words: edits that the frame comes with, for `LookEdits.parse`. rest: the
    files that `finished` writes beside the layers. finished: its layers, already in the space asked for, as
    they are to be written."""

    @property
    def fingerprint(self) -> str: ...
    @property
    def words(self) -> Sequence[str]: ...
    @property
    def rest(self) -> Sequence[Path]: ...
    def finished(self, layers: FrameLayers, camera: Camera) -> FrameLayers: ...


class Sequenced(Protocol):
    """What a folder of frames is made from. `fingerprint` changes whenever all pictures would; elements: names by
    light."""

    @property
    def fingerprint(self) -> str: ...
    @property
    def lights(self) -> Sequence[str]: ...
    @property
    def elements(self) -> Mapping[str, Sequence[str]]: ...


class Renderer(OfCamera, Sequenced, Protocol):
    """A fitted run, as `bake` uses it: a frame is a matter of its camera alone."""


@dataclass(frozen=True)
class _OfView:
    """A frame of such a renderer, as its camera sees it."""

    renderer: Renderer
    camera: Camera
    words: tuple[str, ...] = ()
    rest = ()

    @property
    def fingerprint(self) -> str:
        """Of the camera: a capture that was solved again has other ones under the same names."""
        return hashlib.sha256(repr(self.camera.numbers).encode()).hexdigest()[:16]

    def render(self, camera: Camera, edits: LookEdits | None = None) -> Rendering:
        return self.renderer.render(camera) if edits is None else self.renderer.render(camera, edits)

    def finished(self, layers: FrameLayers, camera: Camera) -> FrameLayers:  # noqa: ARG002 - nothing to add
        return layers


@dataclass(frozen=True)
class BakeSettings:
    """What the layers are to be.

    width, height: in pixels; without a height the frame's proportions are kept, without either its size.
    half: 16 bit floats. edits: words for `LookEdits.parse`. keyed: more of them, by frame number. space: linear
    colour space of the layers, by name; config: OpenColorIO configuration it is looked up in, if any.
    """

    width: int | None = None
    height: int | None = None
    half: bool = True
    edits: tuple[str, ...] = ()
    keyed: KeyedEdits = field(default_factory=KeyedEdits)
    space: str = "linear"
    config: str | None = None

    def scaled(self, camera: Camera) -> Camera:
        """A frame's camera at the size asked for."""
        return camera.scaled(self.width, self.height) if self.width else camera

    def colour_space(self) -> ColourSpace:
        """What the layers are written in. Raises SettingsError."""
        return colour_space(self.space, self.config)


def bake(renderer: Renderer, frames: Sequence[Frame], cameras: Mapping[str, Camera], out: Path | str,
         settings: BakeSettings | None = None, progress: Progress | None = None, *,
         overwrite: bool = False) -> dict[str, Any]:
    """Write the layers of `frames` (cameras by the view's name) under `out`; see `bake_frames`."""
    return bake_frames(renderer, frames, cameras, out, lambda frame: _OfView(renderer, cameras[frame.view]), settings,
                       progress, overwrite=overwrite)


def bake_frames(source: Sequenced, frames: Sequence[Frame], cameras: Mapping[str, Camera], out: Path | str,
                of_frame: Callable[[Frame], FrameRenderer], settings: BakeSettings | None = None,
                progress: Progress | None = None, *, overwrite: bool = False) -> dict[str, Any]:
    """Write the layers of `frames`, each by its own renderer, under `out`; returns the content of bake.json.

    Frames that an earlier bake with the same settings finished are left as they are, and stay in the record.
    Raises RunError where `out` holds layers made with other settings, unless `overwrite`, or another bake begins to
    write such there; SettingsError for edits that make no sense; Cancelled when asked to stop.
    """
    settings, progress, out = settings or BakeSettings(), progress or Progress(), Path(out)
    keyed, lights, elements = settings.keyed.and_always(settings.edits), source.lights, source.elements

    def asked_of(frame: Frame) -> LookEdits:
        asked, own = keyed.at(frame.number, lights, elements), of_frame(frame).words
        return LookEdits.parse([*own, *asked.words()], lights, elements) if own else asked

    edits = {frame.view: asked_of(frame) for frame in frames}  # before anything that is there makes way for it
    space = settings.colour_space()
    made_from = _made_from(source.fingerprint, settings, keyed)
    names = layer_names(lights)
    _begin(out, made_from, names, overwrite)

    def notes(frame: Frame) -> dict[str, Any]:
        """What the frame's header is to say."""
        inputs = of_frame(frame).fingerprint
        own = {"inputs": inputs} if inputs else {}
        return {"view": frame.view, "frame": frame.number, **own, **made_from}

    done = [frame for frame in frames if _is_made(out / frame.file, notes(frame))
            and all(path.is_file() for path in of_frame(frame).rest)]
    record = _add_to_record(out, made_from, names, [_entry(out, frame, of_frame(frame).rest) for frame in done])
    progress.stage("bake", len(frames), len(done))

    def made(frame: Frame) -> FrameLayers:
        camera, one = settings.scaled(cameras[frame.view]), of_frame(frame)
        return one.finished(_layers(one, camera, edits[frame.view], lights).in_space(space), camera)

    @contextlib.contextmanager
    def in_turn() -> Iterator[None]:
        """While a frame takes its name: nobody else writes here, and the folder is still this bake's."""
        with locked(out / LOCK):
            _check_is_of_this(out, made_from, names)
            yield

    for frame in frames:
        if frame in done:
            continue
        path = out / frame.file
        _check_is_of_this(out, made_from, names)  # before it is rendered in vain
        # Not kept in a name: at 4K the layers of one frame are half a gigabyte.
        write_layers(path, made(frame), half=settings.half, chromaticities=space.chromaticities, notes=notes(frame),
                     pixel_aspect=settings.scaled(cameras[frame.view]).pixel_aspect, turn=in_turn())
        record = _add_to_record(out, made_from, names, [_entry(out, frame, of_frame(frame).rest)])
        progress.advance()
    return record


def _layers(renderer: OfCamera, camera: Camera, edits: LookEdits, lights: Sequence[str]) -> FrameLayers:
    """One frame. The colour of whole lights is applied to the finished layers, which is exact for any blend."""
    colours = edits.matrices(lights)
    if edits.colour_of_lights_only:
        return layers_of(renderer.render(camera), colours)
    return layers_of(renderer.render(camera, edits.without_colour_of_lights()), colours)


def _made_from(fingerprint: str, settings: BakeSettings, keyed: KeyedEdits) -> dict[str, Any]:
    """What layers come out otherwise by, as bake.json and their headers have it, and as it is read again."""
    made_from = {"renderer": fingerprint, "half": settings.half, "edits": list(keyed.always),
                 "size": [settings.width, settings.height]}
    if settings.space != "linear" or settings.config is not None:
        made_from["space"] = [settings.space, settings.config, settings.colour_space().meaning]
    if keyed.frames:
        made_from["keyed"] = keyed.described()["frames"]
    as_read: dict[str, Any] = json.loads(json.dumps(made_from))
    return as_read


def replaced(out: Path | str, fingerprint: Callable[[], str], lights: Iterable[str],
             files: Collection[str]) -> list[int]:
    """Numbers of the frames that a bake of these `files` alone, with the usual settings, would take out of `out` if it
    may overwrite: they were made otherwise, and are not made again. fingerprint: of what renders them, which takes time
    for a large scene. Raises RunError where bake.json is damaged."""
    if not (Path(out) / RECORD).exists():
        return []
    record = read_record(out)
    others = sorted({entry["frame"] for entry in record["frames"] if entry["file"] not in files})
    if not others:
        return []
    usual = _made_from(fingerprint(), BakeSettings(), KeyedEdits())
    return [] if (record["made_from"], record["layers"]) == (usual, layer_names(lights)) else others


def _begin(out: Path, made_from: dict[str, Any], names: dict[str, str], overwrite: bool) -> None:
    """Have the folder for this bake: refuse, or clear away, what was made otherwise."""
    with locked(out / LOCK):
        record = read_record(out) if (out / RECORD).exists() else None
        if record is not None and (record["made_from"], record["layers"]) == (made_from, names):
            return
        if record is not None and record["frames"] and not overwrite:
            if record["made_from"] == made_from:
                raise RunError(f"{out} holds layers of the lights {', '.join(record['layers'])}, and these frames have "
                               f"{', '.join(names) or 'none'}: one sequence has the same in all frames. Give all "
                               "frames at once, or another folder, or overwrite them (--overwrite).")
            raise RunError(f"{out} holds layers that were baked from another fit or with other settings; "
                           "choose another folder, or overwrite them (--overwrite).")
        for entry in record["frames"] if record is not None else ():  # a mixture would pass for one sequence
            for file in (entry["file"], *entry.get("rest", ())):
                remove_file(out / file)
        write_json(out / RECORD, {"version": VERSION, "made_from": made_from, "layers": names, "frames": []})


def _is_made(path: Path, wanted: Mapping[str, Any]) -> bool:
    """Whether the file is whole and this frame under these settings, by its own header: other tasks of a farm write
    here too."""
    try:
        if exr_is_cut_off(path):
            return False
        notes = read_description(path)
    except (FrameError, OSError):
        return False
    return all(notes.get(name) == value for name, value in wanted.items())


def _entry(out: Path, frame: Frame, rest: Sequence[Path]) -> dict[str, Any]:
    width, height = window_of(out / frame.file).size
    beside = {"rest": [path.relative_to(out).as_posix() for path in rest]} if rest else {}
    return {"file": frame.file, "frame": frame.number, "view": frame.view, "width": width, "height": height, **beside}


def _check_is_of_this(out: Path, made_from: dict[str, Any], names: dict[str, str]) -> None:
    """Raises RunError where another bake has begun in the folder, with other settings, since this one did."""
    if not (out / RECORD).exists():
        return
    record = read_record(out)
    if (record["made_from"], record["layers"]) != (made_from, names):
        raise RunError(f"Another bake, of another fit or with other settings, writes to {out} meanwhile; choose "
                       "another folder for this one.")


def _add_to_record(out: Path, made_from: dict[str, Any], names: dict[str, str],
                   entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """bake.json with these entries beside those of others who write to this folder. Raises RunError where it tells of
    frames that were made with other settings since this bake began."""
    with locked(out / LOCK):
        _check_is_of_this(out, made_from, names)
        found = read_record(out) if (out / RECORD).exists() else {}
        known = {entry["file"]: entry for entry in found.get("frames", []) if (out / entry["file"]).is_file()}
        known.update({entry["file"]: entry for entry in entries})
        frames = sorted(known.values(), key=lambda entry: (Path(entry["file"]).parent.as_posix(), entry["frame"]))
        record = {"version": VERSION, "made_from": made_from, "layers": names, "frames": frames}
        if record != found:
            write_json(out / RECORD, record)
    return record


def read_record(out: Path | str) -> dict[str, Any]:
    """bake.json of a folder of layers. Raises RunError where it is missing or damaged."""
    path = Path(out) / RECORD
    record = read_json(path, RunError)
    try:
        for entry in record["frames"]:
            rest = entry.get("rest", [])
            if not isinstance(rest, list):
                raise TypeError(f"rest {rest!r:.100}")
            for file in (entry["file"], *rest):
                inside(out, file, RunError)
            for name in ("frame", "width", "height"):
                value_of(int, entry[name])
        if record["version"] != VERSION or not isinstance(record["made_from"], dict):
            raise ValueError(f"version {record['version']}")
        dict(record["layers"]).items()
    except (AttributeError, KeyError, TypeError, ValueError) as problem:
        raise RunError(f"{path} is damaged or from another version ({problem!r}); bake into a new folder.") from problem
    return record
