# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder of a run: where a fit keeps its settings, state and results.

    config.toml   every setting, resolved
    capture.txt   the capture's folder
    exposures.json   times the usual light that each frame was exposed to, where they differ
    flare.flare   the flare            scene.ply   the scene, standard 3DGS
    checkpoint/   state.safetensors    what a resumed fit needs
    metrics.jsonl one line of figures now and then; preview.png, preview_small.png; eval.json; log.txt
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ..capture import Camera, Capture
from ..colour.srgb import Pixels
from ..conventions import exposures
from ..conventions.run_files import CAPTURE, CONFIG, FLARE, SCENE
from ..errors import RunError
from ..flare import file as flare_file
from ..flare.file import FlareFile
from ..gaussians.ply import read_ply
from ..gaussians.scene import SceneGaussians
from ..look import Look, LookEdits
from ..look import read as read_look
from ..system.files import digest_of, remove_file, write_json, write_text
from ..typed import is_utf8
from .rendering import RenderedView, render
from .settings import FitSettings, read_config, write_config


@dataclass(frozen=True)
class ViewLayers:
    """Scene-linear layers of a view, numpy: scene (h, w, 3), each light's flare (h, w, 3), depth (h, w).

    The flares sum to composite - scene. Depth is along the camera's axis, world units, 0 where nothing is.
    """

    scene: Pixels
    flare_by_light: Mapping[str, Pixels]
    depth: Pixels


class Run:
    """A run folder that a fit has made or is making; made by `Run.create` or `Run.open`."""

    def __init__(self, folder: Path, settings: FitSettings, capture_folder: Path) -> None:
        self.folder = folder
        self.settings = settings
        self.capture_folder = capture_folder

    @staticmethod
    def check_free(folder: Path) -> None:
        """Raises RunError where the folder holds a run already, or cannot be one."""
        if (folder / CONFIG).exists():
            raise RunError(f"{folder} holds a run already; go on with it by --resume, or choose another folder.")
        if folder.exists() and not folder.is_dir():
            raise RunError(f"{folder} is a file; name a folder for the run.")

    @classmethod
    def create(cls, folder: Path | str, settings: FitSettings, capture_folder: Path,
               exposed: Mapping[str, float] | None = None) -> Run:
        """A new run folder, with its settings written. exposed: its `exposures`. RunError where the folder holds a run
        already, or the capture's name cannot be written down."""
        folder = Path(folder)
        cls.check_free(folder)
        run = cls(folder, settings, capture_folder.resolve())
        if not is_utf8(str(run.capture_folder)):
            raise RunError(f"The name of the capture's folder, {str(run.capture_folder)!r}, is not UTF-8 and cannot be "
                           "written down; rename it.")
        write_text(folder / CAPTURE, f"{run.capture_folder}\n")
        remove_file(folder / exposures.FILE)  # of a fit that was killed as it began
        if exposed:
            write_json(folder / exposures.FILE, dict(exposed))
        write_config(folder / CONFIG, settings)
        return run

    @classmethod
    def open(cls, folder: Path | str) -> Run:
        """A run folder as it is. RunError where it is none."""
        folder = Path(folder)
        if not (folder / CONFIG).is_file():
            raise RunError(f"{folder} is not the folder of a run (it has no {CONFIG}); name one that fit has written.")
        settings = read_config(folder / CONFIG)
        try:
            capture = Path((folder / CAPTURE).read_text(encoding="utf-8").removesuffix("\n"))
        except OSError as problem:
            raise RunError(f"{folder / CAPTURE} cannot be read ({problem.strerror}); start the fit anew.") from problem
        except UnicodeDecodeError as problem:
            raise RunError(f"{folder / CAPTURE} is not UTF-8 text; start the fit anew.") from problem
        if not capture.name:  # of an empty file it would be the working folder
            raise RunError(f"{folder / CAPTURE} names no capture; start the fit anew.")
        return cls(folder, settings, capture)

    @cached_property
    def exposures(self) -> dict[str, float]:
        """By view, times the usual light; empty where all frames are exposed alike. Raises RunError."""
        return exposures.read(self.folder)

    def capture(self, given: Path | None = None, *, need_frames: bool = True) -> Capture:
        """What it was fitted to, from the folder given or where it was then; the exposures of its frames and the places
        of its lights are those that the fit found, and views whose frames are not needed and not there are as large as
        those that were fitted. Raises RunError, CaptureError, FrameError."""
        found = Capture.open(self.find_capture(given), need_frames=need_frames).exposed(self.exposures)
        if not (self.folder / FLARE).is_file() or self.flare is None:
            return found
        model, lens = self.flare.model, self.flare.camera
        if not need_frames:
            found = found.sized((lens.width, lens.height))
        return found.lit(dict(zip(model.names, model.positions.numpy().astype(np.float64), strict=True)))

    def find_capture(self, given: Path | None) -> Path:
        """The folder of its capture: the one given, else the one it was fitted to. RunError where that is gone."""
        if given is None and not self.capture_folder.is_dir():
            raise RunError(f"The capture that {self.folder} was fitted to, {self.capture_folder}, is not there; say "
                           "where it is now with --capture.")
        return given or self.capture_folder

    @property
    def finished(self) -> bool:
        """Whether the fit ran to its end: the flare is written last."""
        return (self.folder / FLARE).is_file() or (self.settings.mode == "3dgs" and (self.folder / SCENE).is_file())

    @property
    def without_flare(self) -> str:
        """Why there is no flare in it, as a sentence."""
        if self.settings.mode == "3dgs":
            return f"{self.folder} is a fit of the scene alone (mode 3dgs) and has no flare; fit with another --mode."
        return f"{self.folder} has no {FLARE} yet; finish the fit with --resume first."

    @cached_property
    def flare(self) -> FlareFile | None:
        """The fitted flare; None for plain 3DGS."""
        return None if self.settings.mode == "3dgs" else flare_file.load(self._needed(FLARE))

    @cached_property
    def scene(self) -> SceneGaussians:
        """The fitted scene."""
        return read_ply(self._needed(SCENE))

    @cached_property
    def look(self) -> Look | None:
        """The fitted flare as edits see it; None for plain 3DGS."""
        return None if self.settings.mode == "3dgs" else read_look(self._needed(FLARE))

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights, in their order."""
        return self.flare.model.names if self.flare else ()

    @property
    def elements(self) -> dict[str, list[str]]:
        """Names of each light's elements."""
        return self.look.element_names if self.look else {}

    @cached_property
    def fingerprint(self) -> str:
        """Changes whenever a picture of this run would."""
        return digest_of(self.folder / name for name in (SCENE, FLARE))

    def view(self, camera: Camera, edits: LookEdits | None = None) -> RenderedView:
        """Scene, flares and composite as tensors."""
        model, sampling = (self.flare.model, self.flare.sampling) if self.flare else (None, None)
        return render(self.scene, model, self.settings.blend, camera, self.settings.kernels,
                      visibility=self.settings.flare.occluded_by_scene, look=None if edits is None else self.look,
                      edits=edits, sampling=sampling)

    def render(self, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        """The layers of a view at the camera's size, the flare as `edits` change it."""
        view = self.view(camera, edits)
        flares = {name: layer.numpy() for name, layer in view.layers.flares.items()}
        dark = np.zeros_like(view.layers.scene.numpy())
        return ViewLayers(view.layers.scene.numpy(), {name: flares.get(name, dark) for name in self.lights},
                          view.scene.depth.numpy())

    def _needed(self, name: str) -> Path:
        if not (self.folder / name).is_file():
            raise RunError(self.without_flare if name == FLARE else
                           f"{self.folder} has no {name} yet; finish the fit with --resume first.")
        return self.folder / name
