# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that makes a look of the library from a lens prescription, in the engine."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...core.errors import SettingsError
from ...core.optics.lenses import find_lens, lens_names
from ...core.optics.prescription import read_prescription
from .. import asset_browser, engine, jobs, library
from ..reports import GuardedOperator
from ..user_settings import user_folder

FILE = "FILE"
_items: list[tuple[str, str, str]] = []


def making_job() -> jobs.Job | None:
    """Return the job of the flare that is being made, or that was made last; None without one."""
    return jobs.find_job(user_folder("make_flare"))


def _lens_items(_self: Any, _context: Any) -> list[tuple[str, str, str]]:
    """Return the lenses as menu items, kept here since Blender holds no reference to the texts."""
    global _items
    if not _items:
        lenses = sorted(((find_lens(name), name) for name in lens_names()), key=lambda pair: pair[0].focal_length())
        _items = [*((name, f"{lens.focal_length():.0f} mm f/{lens.widest_f_number():.1f} ({name})",
                     f"The lens of the patent {name}") for lens, name in lenses),
                  (FILE, "Lens File", "A prescription of your own in the .lens format")]
    return _items


def _on_finished(job: jobs.Job) -> None:
    """Choose the new look in the panel Library, and offer it as an asset."""
    target = job.args[job.args.index("--out") + 1] if "--out" in job.args else ""
    number = next((item[-1] for item in library.menu_items() if item[0] == target), None)
    if job.state == "done" and number is not None:
        library.choose(None, number)
        asset_browser.update_assets()
    jobs.redraw_bars()


jobs.ON_FINISHED["make flare"] = _on_finished


class FITFLARE_OT_make_flare(GuardedOperator, bpy.types.Operator):
    """Trace a lens and add its flare to the library; the engine needs some minutes"""

    bl_idname = "fit_flare.make_flare"
    bl_label = "Make from Lens"
    changes_scene = False

    name: bpy.props.StringProperty(name="Name", description="Name of the look in the library", default="My Lens")  # type: ignore[valid-type]
    lens: bpy.props.EnumProperty(name="Lens", description="The prescription to trace", items=_lens_items)  # type: ignore[valid-type]
    filepath: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="File", description="A prescription in the .lens format", subtype="FILE_PATH")
    f_number: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="F-Number", description="Opening of the iris; 0 is two stops below the widest", default=0.0, min=0.0,
        soft_max=22.0, max=64.0)
    blades: bpy.props.IntProperty(name="Blades", description="Blades of the iris", default=8, min=3, max=32)  # type: ignore[valid-type]
    squeeze: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Squeeze", description="Squeeze of an anamorphic lens; 1 is spherical", default=1.0, min=1.0, max=4.0)
    streak: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Streak", description="Brightness of a horizontal streak; 0 is none", default=0.0, min=0.0, soft_max=2.0,
        max=100.0)
    ring: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Ring", description="Brightness of a ring around the light; 0 is none", default=0.0, min=0.0,
        soft_max=0.5, max=100.0)
    dust: bpy.props.IntProperty(name="Dust", description="Specks of dust on the glass", default=30, min=0, max=1000)  # type: ignore[valid-type]
    scratches: bpy.props.IntProperty(name="Scratches", description="Scratches on the glass", default=0, min=0, max=200)  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        job = making_job()
        return "A flare is being made" if job is not None and job.running else engine.missing_reason()

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=360, confirm_text="Make")

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        for name in ("name", "lens", *(("filepath",) if self.lens == FILE else ()), "f_number", "blades", "squeeze",
                     "streak", "ring", "dust", "scratches"):
            layout.prop(self, name)

    def act(self, _context: bpy.types.Context) -> None:
        """Start the command `make-flare`; options at 0, and a squeeze of 1, are left to its defaults."""
        lens = bpy.path.abspath(self.filepath) if self.lens == FILE else self.lens
        if not lens:
            raise SettingsError("Choose a .lens file first.")
        if self.lens == FILE:
            read_prescription(Path(lens))  # a bad file is reported at once
        target = library.free_path(self.name)
        options = {"--f-number": self.f_number, "--squeeze": self.squeeze if self.squeeze != 1 else 0.0,
                   "--streak": self.streak, "--ring": self.ring}
        option_args = [arg for name, value in options.items() if value for arg in (name, f"{value:.6g}")]
        engine.run("make flare", user_folder("make_flare", create=True), [
            "make-flare", lens, "--out", target, "--blades", self.blades, "--dust", self.dust, "--scratches",
            self.scratches, *option_args])


def register() -> None:
    bpy.utils.register_class(FITFLARE_OT_make_flare)


def unregister() -> None:
    bpy.utils.unregister_class(FITFLARE_OT_make_flare)
