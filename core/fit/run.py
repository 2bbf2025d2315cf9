# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder of a run, with the settings, state and results of a fit; bakes, scores and transfers read it.

    config.toml     every setting, resolved
    capture.txt     the capture's folder
    exposures.json  exposure of each frame relative to the median frame, where they differ
    flare.flare     the flare            scene.ply   the scene, standard 3DGS
    plates/         in place of scene.ply, one plate per frame, for a shot without a camera solve
    lights.json     places and fitted brightness of the lights by frame, where they move or change
    checkpoint/     state.safetensors    the state that a resumed fit needs
    metrics.jsonl   one line of figures at intervals; preview.png, preview_small.png; eval.json; log.txt
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ..capture import Camera, Capture, read_lights
from ..choices import Device
from ..colour.srgb import Pixels
from ..conventions import exposures
from ..conventions.run_files import CAPTURE, CONFIG, FLARE, FRAME_LIGHTS, PLATES, SCENE
from ..errors import RunError
from ..flare import file as flare_file
from ..flare.file import FlareFile
from ..gaussians.device import select_device
from ..gaussians.ply import read_ply
from ..gaussians.scene import SceneGaussians
from ..look import Look, LookEdits, read_look
from ..system.files import hash_files, remove_file, write_json, write_text
from ..system.progress import Progress
from ..system.reading import MAX_PATH_BYTES, read_text
from ..typed import is_utf8
from .config import read_config, write_config
from .light_results import make_frame_lights
from .plate_scene import PlateScene
from .rendering import RenderedView, Scene, render
from .settings import FitSettings


@dataclass(frozen=True)
class ViewLayers:
    """Scene-linear layers of a view, numpy: scene (h, w, 3), flare of each light (h, w, 3), depth (h, w).

    The flares sum to composite - scene. Depth is along the camera's axis, world units, 0 where nothing is.
    """

    scene: Pixels
    flare_by_light: Mapping[str, Pixels]
    depth: Pixels


class Run:
    """The folder of a finished or unfinished fit; made by `Run.create` or `Run.open`."""

    def __init__(self, folder: Path, settings: FitSettings, capture_folder: Path, device: Device = "cpu") -> None:
        """Name the folder of a run, its settings and its capture.

        device: where scene and flare are rendered; a fit computes where its settings say.
        """
        self.folder = folder
        self.settings = settings
        self.device = select_device(device)
        self.capture_folder = capture_folder
        self._last_opened: Capture | None = None

    @staticmethod
    def check_free(folder: Path) -> None:
        """Raise RunError if the folder holds a run, or cannot be one."""
        if (folder / CONFIG).exists():
            raise RunError(f"{folder} holds a run already; resume it with --resume, or choose another folder.")
        if folder.exists() and not folder.is_dir():
            raise RunError(f"{folder} is a file; name a folder for the run.")

    @classmethod
    def create(cls, folder: Path | str, settings: FitSettings, capture_folder: Path,
               exposure_by_view: Mapping[str, float] | None = None) -> Run:
        """Make a new run folder with its settings.

        exposure_by_view: exposure of each view, by name, relative to the median frame; None or empty if all are equal.
        Raises RunError if the folder holds a run, or the capture's name is not UTF-8.
        """
        folder = Path(folder)
        cls.check_free(folder)
        run = cls(folder, settings, capture_folder.resolve())
        if not is_utf8(str(run.capture_folder)):
            raise RunError(f"The name of the capture's folder, {str(run.capture_folder)!r}, is not UTF-8 and cannot be "
                           "written down; rename it.")
        write_text(folder / CAPTURE, f"{run.capture_folder}\n")
        remove_file(folder / exposures.FILE)  # left by a fit that was killed as it began
        if exposure_by_view:
            write_json(folder / exposures.FILE, dict(exposure_by_view))
        write_config(folder / CONFIG, settings)
        return run

    @classmethod
    def open(cls, folder: Path | str, progress: Progress | None = None, *, device: Device = "cpu") -> Run:
        """Open the run in a folder; with `progress`, old names of settings are reported to the user.

        device: where scene and flare are rendered. Raises RunError if the folder is no run, EngineError for a device
        that cannot be used.
        """
        folder = Path(folder)
        if not (folder / CONFIG).is_file():
            raise RunError(f"{folder} is not the folder of a run (it has no {CONFIG}); name one that fit has written.")
        settings = read_config(folder / CONFIG, progress)
        try:
            capture_folder = Path(read_text(folder / CAPTURE, MAX_PATH_BYTES).removesuffix("\n"))
        except OSError as problem:
            raise RunError(f"{folder / CAPTURE} cannot be read ({problem.strerror}); start the fit anew.") from problem
        except UnicodeDecodeError as problem:
            raise RunError(f"{folder / CAPTURE} is not UTF-8 text; start the fit anew.") from problem
        if not capture_folder.name:  # an empty file would give the working folder
            raise RunError(f"{folder / CAPTURE} names no capture; start the fit anew.")
        return cls(folder, settings, capture_folder, device)

    @cached_property
    def exposures(self) -> dict[str, float]:
        """Exposure of each view relative to the median frame; empty if all are equal. Raises RunError."""
        return exposures.read_exposures(self.folder)

    def open_capture(self, folder: Path | None = None, *, need_frames: bool = True) -> Capture:
        """Open the capture of the run, in `folder`, or where it was fitted if that is None.

        The capture gets the exposures and light positions of the fit, and is remembered for the run's scene and flare.
        Without `need_frames`, views whose frames are missing have the size of the fitted frames. Raises RunError,
        CaptureError, FrameError.
        """
        capture = Capture.open(self.find_capture(folder), need_frames=need_frames,
                               need_cameras=not self.settings.uses_plates).with_exposures(self.exposures)
        self._last_opened = capture = self._with_lights(capture)
        if not (self.folder / FLARE).is_file() or self.flare is None:
            return capture
        model, lens = self.flare.model, self.flare.camera
        if not need_frames:
            capture = capture.with_frame_size((lens.width, lens.height))
        return capture.with_lights_at(dict(zip(model.names, model.positions.numpy().astype(np.float64), strict=True)))

    def _with_lights(self, capture: Capture) -> Capture:
        """Return the capture with the run's lights by frame, if it has them; its cameras then name their frames."""
        path = self.folder / FRAME_LIGHTS
        return capture.with_lights(read_lights(path)).with_frame_names() if path.is_file() else capture

    def _opened_capture(self) -> Capture:
        """Return the capture that was opened last; opens it if there is none."""
        return self._last_opened or self.open_capture(need_frames=False)

    def find_capture(self, folder: Path | None) -> Path:
        """Return the folder of the capture: `folder`, else the one that was fitted. Raises RunError if that is missing.
        """
        if folder is None and not self.capture_folder.is_dir():
            raise RunError(f"The capture that {self.folder} was fitted to, {self.capture_folder}, does not exist; "
                           "name its present folder with --capture.")
        return folder or self.capture_folder

    @property
    def finished(self) -> bool:
        """Return whether the fit ran to its end: the flare is written last."""
        return (self.folder / FLARE).is_file() or (self.settings.mode == "3dgs" and (self.folder / SCENE).is_file())

    @property
    def missing_flare_message(self) -> str:
        """Sentence on why the run has no flare."""
        if self.settings.mode == "3dgs":
            return f"{self.folder} is a fit of the scene alone (mode 3dgs) and has no flare; fit with another --mode."
        return f"{self.folder} has no {FLARE} yet; finish the fit with --resume first."

    @cached_property
    def flare(self) -> FlareFile | None:
        """The fitted flare; None for plain 3DGS."""
        if self.settings.mode == "3dgs":
            return None
        flare = flare_file.load(self._require(FLARE))
        if (self.folder / FRAME_LIGHTS).is_file():
            flare.model.frame_lights = make_frame_lights(self._opened_capture(), flare.model.names)
        flare.model.move_to(self.device)
        return flare

    @cached_property
    def scene(self) -> Scene:
        """The fitted scene: Gaussians, or one plate per frame. Raises RunError."""
        if not self.settings.uses_plates:
            return read_ply(self._require(SCENE)).to(self.device)
        if not (self.folder / PLATES).is_dir():
            raise RunError(f"{self.folder} has no {PLATES}/ yet; finish the fit with --resume first.")
        capture = self._opened_capture()
        return PlateScene.from_folder(self.folder / PLATES, {view.name: view.camera for view in capture.views},
                                      self.settings.display_white, capture.plate_space)

    @property
    def gaussians(self) -> SceneGaussians:
        """The fitted scene as Gaussians. Raises RunError for a scene of plates."""
        if isinstance(self.scene, SceneGaussians):
            return self.scene
        raise RunError(f"The scene of {self.folder} is one plate per frame: it has no 3D, and other cameras cannot see "
                       "it; use its flare alone (flare.flare).")

    @cached_property
    def look(self) -> Look | None:
        """The fitted flare for edits; None for plain 3DGS."""
        return None if self.settings.mode == "3dgs" else read_look(self._require(FLARE))

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
        """A digest that changes with any picture of this run."""
        plates = sorted((self.folder / PLATES).rglob("*.*")) if self.settings.uses_plates else []
        return hash_files([*(self.folder / name for name in (SCENE, FLARE, FRAME_LIGHTS)), *plates])

    def render_view(self, camera: Camera, edits: LookEdits | None = None) -> RenderedView:
        """Render scene, flares and composite of a view as tensors."""
        model, pixel_grid = (self.flare.model, self.flare.pixel_grid) if self.flare else (None, None)
        return render(self.scene, model, self.settings.blend, camera, self.settings.kernels,
                      visibility=self.settings.flare.active_visibility, look=None if edits is None else self.look,
                      edits=edits, pixel_grid=pixel_grid)

    def render(self, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        """Render the layers of a view at the camera's size, as numpy arrays, with the flare under `edits`; lights
        behind the camera have black layers."""
        view = self.render_view(camera, edits)
        flares = {name: layer.numpy() for name, layer in view.layers.flares.items()}
        dark = np.zeros_like(view.layers.scene.numpy())
        return ViewLayers(view.layers.scene.numpy(), {name: flares.get(name, dark) for name in self.lights},
                          view.scene.depth.numpy())

    def _require(self, name: str) -> Path:
        if not (self.folder / name).is_file():
            raise RunError(self.missing_flare_message if name == FLARE else
                           f"{self.folder} has no {name} yet; finish the fit with --resume first.")
        return self.folder / name
