# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes a run from its views, one EXR per frame, into a folder whose bake resumes after any stop.

A frame is rendered unless its file exists and its header names the same settings, so any number of processes may share
a folder. `bake.json`, the manifest, lists the whole files; it is written after each frame. The commands and
`core.bake.shot` and `core.transfer` call `bake_frames`.
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
from ..capture.renderer import RenderedLayers
from ..colour import ColourSpace, colour_space
from ..conventions.frame_numbers import NumberedFrame
from ..errors import FrameError, RunError
from ..images.formats import exr_header
from ..look import KeyedEdits, LookEdits
from ..system.files import check_names, file_lock, read_json, remove_file, write_json
from ..system.progress import Progress
from ..system.reading import open_regular
from ..system.steps import FRAMES_PER_STEP, Steps, finish
from ..typed import parse_value
from .exr import read_description, write_layers
from .layers import FrameLayers, layer_names, to_layers

MANIFEST = "bake.json"
LOCK = ".bake.lock"
VERSION = 1


class CameraRenderer(Protocol):
    """A renderer of the layers that a camera sees, with edits."""

    def render(self, camera: Camera, edits: LookEdits | None = None) -> RenderedLayers: ...


class FrameRenderer(CameraRenderer, Protocol):
    """The renderer of one frame.

    fingerprint: changes with this frame's picture, beyond the source's; empty if nothing is the frame's alone.
    edit_texts: edits of this frame, for `LookEdits.parse`. extra_files: files that `finish` writes beside the layers.
    finish: returns the layers as they are written, given those in the chosen colour space.
    """

    @property
    def fingerprint(self) -> str: ...
    @property
    def edit_texts(self) -> Sequence[str]: ...
    @property
    def extra_files(self) -> Sequence[Path]: ...
    def finish(self, layers: FrameLayers, camera: Camera) -> FrameLayers: ...


class SequenceSource(Protocol):
    """The source of a sequence of frames. fingerprint: digest of what all frames share. elements: names by light."""

    @property
    def fingerprint(self) -> str: ...
    @property
    def lights(self) -> Sequence[str]: ...
    @property
    def elements(self) -> Mapping[str, Sequence[str]]: ...


class RunRenderer(CameraRenderer, SequenceSource, Protocol):
    """A fitted run, as `bake` uses it: a frame depends on its camera alone."""


@dataclass(frozen=True)
class _ViewRenderer:
    """The renderer of one view of a run."""

    renderer: RunRenderer
    camera: Camera
    edit_texts: tuple[str, ...] = ()
    extra_files = ()

    @property
    def fingerprint(self) -> str:
        """Digest of the camera: a capture that was solved again has other cameras under the same names."""
        return hashlib.sha256(repr(self.camera.numbers).encode()).hexdigest()[:16]

    def render(self, camera: Camera, edits: LookEdits | None = None) -> RenderedLayers:
        return self.renderer.render(camera) if edits is None else self.renderer.render(camera, edits)

    def finish(self, layers: FrameLayers, camera: Camera) -> FrameLayers:  # noqa: ARG002 - nothing to add
        return layers


@dataclass(frozen=True)
class BakeSettings:
    """Size, precision, edits and colour space of the layers.

    width, height: in pixels; without a height the frame's proportions are kept, without either its size. half: 16 bit
    floats. edits: texts for `LookEdits.parse`. keyed: edits by frame number. space: linear colour space of the layers,
    by name; config: OpenColorIO configuration with that space, if any.
    """

    width: int | None = None
    height: int | None = None
    half: bool = True
    edits: tuple[str, ...] = ()
    keyed: KeyedEdits = field(default_factory=KeyedEdits)
    space: str = "linear"
    config: str | None = None

    def scaled(self, camera: Camera) -> Camera:
        """Return a frame's camera at the size of the layers."""
        return camera.scaled(self.width, self.height) if self.width else camera

    def colour_space(self) -> ColourSpace:
        """Return the colour space of the layers. Raises SettingsError."""
        return colour_space(self.space, self.config)


def bake(renderer: RunRenderer, frames: Sequence[NumberedFrame], cameras: Mapping[str, Camera], out: Path | str,
         settings: BakeSettings | None = None, progress: Progress | None = None, *,
         overwrite: bool = False) -> dict[str, Any]:
    """Write the layers of `frames` (cameras by the view's name) under `out`; see `bake_frames`."""
    return bake_frames(renderer, frames, cameras, out, lambda frame: _ViewRenderer(renderer, cameras[frame.view]),
                       settings, progress, overwrite=overwrite)


def bake_frames(source: SequenceSource, frames: Sequence[NumberedFrame], cameras: Mapping[str, Camera], out: Path | str,
                renderer_for: Callable[[NumberedFrame], FrameRenderer], settings: BakeSettings | None = None,
                progress: Progress | None = None, *, overwrite: bool = False) -> dict[str, Any]:
    """Write the layers of `frames`, each by its own renderer, under `out`; return the content of bake.json.

    cameras: by the view's name, at the size of the frames. renderer_for: returns the renderer of a frame.

    Frames that an earlier bake with the same settings finished are kept, and stay in the manifest. Raises RunError if
    `out` holds layers made with other settings, unless `overwrite`, or a bake with other settings takes the folder over
    meanwhile; SettingsError for invalid edits; Cancelled on a stop request.
    """
    settings, progress, out = settings or BakeSettings(), progress or Progress(), Path(out)
    keyed, lights, elements = settings.keyed.with_always(settings.edits), source.lights, source.elements
    # Invalid edits raise before any file is deleted.
    edits = {frame.view: _parse_edits(frame.number, renderer_for(frame), keyed, lights, elements) for frame in frames}
    writer = _FrameWriter(out, settings, settings.colour_space(), cameras, renderer_for, lights,
                          _cache_key(source.fingerprint, settings, keyed), layer_names(lights))
    _claim_folder(out, writer.cache_key, writer.layer_by_light, overwrite)
    finished = [frame for frame in frames if writer.is_finished(frame)]
    manifest = writer.add_to_manifest(finished)
    progress.stage("bake", len(frames), len(finished))
    for frame in frames:
        if frame in finished:
            continue
        writer.write(frame, edits[frame.view])
        manifest = writer.add_to_manifest([frame])
        progress.advance()
    return manifest


@dataclass(frozen=True, eq=False)
class _FrameWriter:
    """Renders and writes the frames of one bake into its folder `out`.

    space: of the layers. cameras: by the view's name. renderer_for: returns the renderer of a frame. cache_key: what
    the layers were made from. layer_by_light: name of each light's layer.
    """

    out: Path
    settings: BakeSettings
    space: ColourSpace
    cameras: Mapping[str, Camera]
    renderer_for: Callable[[NumberedFrame], FrameRenderer]
    lights: Sequence[str]
    cache_key: dict[str, Any]
    layer_by_light: dict[str, str]

    def is_finished(self, frame: NumberedFrame) -> bool:
        """Return whether the layers of the frame and the files beside them are up to date."""
        return (_is_up_to_date(self.out / frame.file, self._header_notes(frame))
                and all(path.is_file() for path in self.renderer_for(frame).extra_files))

    def write(self, frame: NumberedFrame, edits: LookEdits) -> None:
        """Render and write the layers of a frame. Raises RunError if another bake has taken the folder."""
        _check_is_current(self.out, self.cache_key, self.layer_by_light)  # before it is rendered in vain
        # The layers have no name here, so that they are freed early: at 4K those of one frame are half a gigabyte.
        write_layers(self.out / frame.file, self._render(frame, edits), half=self.settings.half,
                     chromaticities=self.space.chromaticities, notes=self._header_notes(frame),
                     pixel_aspect=self._camera(frame).pixel_aspect, commit_lock=self._commit_lock())

    def add_to_manifest(self, frames: Iterable[NumberedFrame]) -> dict[str, Any]:
        """Add finished frames to bake.json; return its content."""
        return _add_to_manifest(self.out, self.cache_key, self.layer_by_light, [
            _manifest_entry(self.out, frame, self.renderer_for(frame).extra_files) for frame in frames])

    def _camera(self, frame: NumberedFrame) -> Camera:
        """Return the camera of a frame at the size of the layers."""
        return self.settings.scaled(self.cameras[frame.view])

    def _render(self, frame: NumberedFrame, edits: LookEdits) -> FrameLayers:
        """Render the layers of a frame in their colour space."""
        camera, renderer = self._camera(frame), self.renderer_for(frame)
        return renderer.finish(_render_layers(renderer, camera, edits, self.lights).in_space(self.space), camera)

    def _header_notes(self, frame: NumberedFrame) -> dict[str, Any]:
        """Return the entries of a frame's header, by which `_is_up_to_date` recognises the frame."""
        inputs = self.renderer_for(frame).fingerprint
        inputs_entry = {"inputs": inputs} if inputs else {}
        return {"view": frame.view, "frame": frame.number, **inputs_entry, **self.cache_key}

    @contextlib.contextmanager
    def _commit_lock(self) -> Iterator[None]:
        """Hold the folder's lock while a finished file takes its name. Raises RunError if another bake has taken the
        folder."""
        with file_lock(self.out / LOCK):
            _check_is_current(self.out, self.cache_key, self.layer_by_light)
            yield


def _parse_edits(number: int, renderer: FrameRenderer, keyed: KeyedEdits, lights: Sequence[str],
                 elements: Mapping[str, Sequence[str]]) -> LookEdits:
    """Return the edits of the frame `number`: its renderer's, combined with the keyed ones. Raises SettingsError."""
    keyed_edits, frame_edits = keyed.edits_at(number, lights, elements), renderer.edit_texts
    return LookEdits.parse([*frame_edits, *keyed_edits.texts()], lights, elements) if frame_edits else keyed_edits


def _render_layers(renderer: CameraRenderer, camera: Camera, edits: LookEdits, lights: Sequence[str]) -> FrameLayers:
    """Render the layers of one frame. The colours of whole lights are applied to the finished layers, which is exact
    for any blend."""
    matrices = edits.colour_matrices(lights)
    if edits.changes_light_colours_only:
        return to_layers(renderer.render(camera), matrices)
    return to_layers(renderer.render(camera, edits.without_light_colours()), matrices)


def _cache_key(fingerprint: str, settings: BakeSettings, keyed: KeyedEdits) -> dict[str, Any]:
    """Return everything that changes the layers, in the form of bake.json and of their headers."""
    cache_key = {"renderer": fingerprint, "half": settings.half, "edits": list(keyed.always),
                 "size": [settings.width, settings.height]}
    if settings.space != "linear" or settings.config is not None:
        cache_key["space"] = [settings.space, settings.config, settings.colour_space().fingerprint]
    if keyed.frames:
        cache_key["keyed"] = keyed.to_json()["frames"]
    # As it is read back from a file: tuples become lists.
    normalised: dict[str, Any] = json.loads(json.dumps(cache_key))
    return normalised


def frames_to_delete(out: Path | str, fingerprint: Callable[[], str], lights: Iterable[str],
                     files: Collection[str]) -> list[int]:
    """Return the numbers of the frames that a bake of `files` with default settings and `overwrite` would delete from
    `out`.

    They were made with other settings, and `files` does not replace them. fingerprint: computes that of the renderer;
    called only where needed, since it takes time for a large scene. Raises RunError if bake.json is damaged.
    """
    if not (Path(out) / MANIFEST).exists():
        return []
    manifest = read_manifest(out)
    others = sorted({entry["frame"] for entry in manifest["frames"] if entry["file"] not in files})
    if not others:
        return []
    default = _cache_key(fingerprint(), BakeSettings(), KeyedEdits())
    return [] if (manifest["made_from"], manifest["layers"]) == (default, layer_names(lights)) else others


def _claim_folder(out: Path, cache_key: dict[str, Any], layer_by_light: dict[str, str], overwrite: bool) -> None:
    """Prepare the folder for this bake, and write its empty manifest. Deletes the layers of another bake if
    `overwrite`, else raises RunError."""
    with file_lock(out / LOCK):
        manifest = read_manifest(out) if (out / MANIFEST).exists() else None
        if manifest is not None and (manifest["made_from"], manifest["layers"]) == (cache_key, layer_by_light):
            return
        if manifest is not None and manifest["frames"] and not overwrite:
            if manifest["made_from"] == cache_key:
                raise RunError(f"{out} holds layers of the lights {', '.join(manifest['layers'])}, and these frames "
                               f"have {', '.join(layer_by_light) or 'none'}: one sequence has the same in all frames. "
                               "Give all frames at once, or another folder, or overwrite them (--overwrite).")
            raise RunError(f"{out} holds layers that were baked from another fit or with other settings; "
                           "choose another folder, or overwrite them (--overwrite).")
        for entry in manifest["frames"] if manifest is not None else ():  # else both bakes would look like one sequence
            for file in (entry["file"], *entry.get("rest", ())):
                remove_file(out / file)
        write_json(out / MANIFEST, {"version": VERSION, "made_from": cache_key, "layers": layer_by_light, "frames": []})


def _is_up_to_date(path: Path, expected: Mapping[str, Any]) -> bool:
    """Return whether the file is whole and its own header has the `expected` entries: the frame and its settings.

    bake.json does not show it, since other tasks of a farm write here too."""
    try:
        notes = read_description(path)
    except FrameError:
        return False
    return all(notes.get(name) == value for name, value in expected.items())


def _manifest_entry(out: Path, frame: NumberedFrame, extra_files: Sequence[Path]) -> dict[str, Any]:
    """Return the entry of a finished frame in bake.json."""
    with open_regular(out / frame.file) as stream:
        width, height = exr_header.windows(stream)["dataWindow"]
    extra = {"rest": [path.relative_to(out).as_posix() for path in extra_files]} if extra_files else {}
    return {"file": frame.file, "frame": frame.number, "view": frame.view, "width": width, "height": height, **extra}


def _check_is_current(out: Path, cache_key: dict[str, Any], layer_by_light: dict[str, str]) -> None:
    """Raise RunError if a bake with other settings has started in the folder since this one did."""
    if not (out / MANIFEST).exists():
        return
    manifest = read_manifest(out)
    if (manifest["made_from"], manifest["layers"]) != (cache_key, layer_by_light):
        raise RunError(f"Another bake, of another fit or with other settings, writes to {out} meanwhile; choose "
                       "another folder for this one.")


def _add_to_manifest(out: Path, cache_key: dict[str, Any], layer_by_light: dict[str, str],
                     entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Add entries to bake.json beside those of other writers.

    Raises RunError if it lists frames that were made with other settings since this bake started.
    """
    with file_lock(out / LOCK):
        _check_is_current(out, cache_key, layer_by_light)
        existing = read_manifest(out) if (out / MANIFEST).exists() else {}
        # Entries whose files are gone are dropped.
        by_file = {entry["file"]: entry for entry in existing.get("frames", []) if (out / entry["file"]).is_file()}
        by_file.update({entry["file"]: entry for entry in entries})
        frames = sorted(by_file.values(), key=lambda entry: (Path(entry["file"]).parent.as_posix(), entry["frame"]))
        manifest = {"version": VERSION, "made_from": cache_key, "layers": layer_by_light, "frames": frames}
        if manifest != existing:
            write_json(out / MANIFEST, manifest)
    return manifest


def read_manifest(out: Path | str) -> dict[str, Any]:
    """Read bake.json of a folder of layers. Raises RunError if it is missing or damaged."""
    return finish(read_manifest_in_steps(out))


def read_manifest_in_steps(out: Path | str) -> Steps[dict[str, Any]]:
    """Read bake.json as `read_manifest` does, in steps of FRAMES_PER_STEP frames. Raises RunError."""
    path = Path(out) / MANIFEST
    manifest: dict[str, Any] = read_json(path, RunError)
    try:
        files: list[str] = []
        for entry in manifest["frames"]:
            extra_files = entry.get("rest", [])
            if not isinstance(extra_files, list):
                raise TypeError(f"rest {extra_files!r:.100}")
            files += [entry["file"], *extra_files]
            for name in ("frame", "width", "height"):
                parse_value(int, entry[name])
        for index, _ in enumerate(check_names(out, files, RunError), 1):
            if index % FRAMES_PER_STEP == 0:
                yield
        if manifest["version"] != VERSION or not isinstance(manifest["made_from"], dict):
            raise ValueError(f"version {manifest['version']}")
        dict(manifest["layers"]).items()
    except (AttributeError, KeyError, TypeError, ValueError) as problem:
        raise RunError(f"{path} is damaged or from another version ({problem!r}); bake into a new folder.") from problem
    return manifest
