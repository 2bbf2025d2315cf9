# SPDX-License-Identifier: GPL-3.0-or-later
"""What a fit was given, as its checkpoint notes it: one that is gone on with needs the same frames, cameras and
lights."""
from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from ..capture import LIGHTS, Capture, View
from ..errors import RunError
from ..system.files import content_of

SAME_PLACE = 1e-5
"""Share of the extent within which a light that was given is where it was."""


class Given:
    """The lights of a capture, where the fit has `lights`, and of each view a digest of its camera, its frame and, if
    the fit looks at `removed`, its flare-free frame."""

    def __init__(self, capture: Capture, *, removed: bool, lights: bool) -> None:
        self._capture, self._removed = capture, removed
        self._lights = [[light.name, light.xyz.tolist()] for light in capture.lights] if lights else None
        self._views: list[list[str]] | None = None

    def note(self) -> dict[str, Any]:
        """For the checkpoint: "lights" ([name, [x, y, z]], as the capture has them, wherever the fit has put them
        since), if it was given some, and "views" ([name, digest])."""
        if self._views is None:
            self._views = [[view.name, self._digest(view)] for view in self._capture.views]
        return {"views": self._views, **({} if self._lights is None else {"lights": self._lights})}

    def check(self, noted: dict[str, Any]) -> None:
        """Raises RunError where a checkpoint's note is of something else: flares belong to lights by their order, and
        what was learned of a frame to that frame. Notes of earlier versions say less."""
        now = self.note()
        if "lights" in now and noted.get("lights") is not None and (
                changed := _difference(noted["lights"], now["lights"], SAME_PLACE * self._capture.extent)):
            raise RunError(f"{self._capture.folder / LIGHTS} has changed since the fit began ({changed}); put "
                           "the old one back, or begin the fit anew in another folder.")
        before, after = dict(noted.get("views") or []), dict(now["views"])
        if before and (others := [name for name in {**before, **after} if before.get(name) != after.get(name)]):
            raise RunError(f"{self._capture.folder} has changed since the fit began ({len(others)} of {len(after)} "
                           f"views have another frame, flare-free frame or camera, {others[0]} first); put the old "
                           "ones back, or begin the fit anew in another folder.")

    def _digest(self, view: View) -> str:
        capture, camera = self._capture, view.camera
        files = [capture.frame_path(view), *([capture.removed_path(view)] if self._removed else [])]
        rotation, place = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        numbers = [*np.round(rotation, 5).ravel() + 0.0, *place, camera.fx, camera.fy, camera.cx, camera.cy]
        what = [*map(content_of, files), *(f"{number:.5g}" for number in numbers), str(view.lens)]
        return hashlib.blake2b(" ".join(what).encode(), digest_size=8).hexdigest()


def _difference(begun: list[Any], given: list[Any], apart: float) -> str:
    """What has changed in a list of [name, [x, y, z]], or "": the names, or else the first place, by more than `apart`
    or what Blender's own numbers round to."""
    before, after = ([name for name, _ in lights] for lights in (begun, given))
    if before != after:
        return f"its lights were {', '.join(map(repr, before))}, and are {', '.join(map(repr, after))} now"
    return next((f"{name!r} was at {old}, and is at {new} now"
                 for (name, old), (_, new) in zip(begun, given, strict=True)
                 if not np.allclose(old, new, rtol=1e-6, atol=apart)), "")
