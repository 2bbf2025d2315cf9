# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: the extension from a static repository, and the weights from it. Arguments: the repository's
index.json, a capture, a folder to write."""
from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, patch

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import leave, refusal

sys.path.remove(str(Path(__file__).parent))
index, capture, out = map(Path, sys.argv[1:4])
os.environ.pop("FIT_FLARE_WEIGHTS", None)
facts: dict[str, object] = {}


def part(name):
    return importlib.import_module(f"bl_ext.ours.fit_flare.{name}")


def drawn(panel):
    """The texts of the labels and buttons that a panel draws, in one line."""
    layout = MagicMock()
    panel.draw(SimpleNamespace(layout=layout, engine="", weights="", library=""), bpy.context)
    return " ".join(call.kwargs.get("text", call.args[0] if call.args else "") for call in layout.mock_calls
                    if call[0].rpartition(".")[2] in ("label", "operator"))


bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
system = bpy.context.preferences.system
repositories = bpy.context.preferences.extensions.repos
repositories.new(name="Ours", module="ours", remote_url=index.as_uri())
number = next(place for place, item in enumerate(repositories) if item.module == "ours")
system.use_online_access = True
bpy.ops.extensions.repo_sync(repo_index=number)
bpy.ops.extensions.package_install(repo_index=number, pkg_id="fit_flare", enable_on_install=True)
facts["enabled"] = "bl_ext.ours.fit_flare" in bpy.context.preferences.addons

# ---- weights ----
weights, fits, engine, preferences = (part(f"flare_addon.{name}")
                                      for name in ("weights", "fits", "engine", "preferences"))
package = Path(weights.__file__).parents[1]
facts["in the package"] = [path.name for path in package.rglob("*.safetensors")]
facts["offered"] = weights.published_url().rpartition("/")[2] == weights.published_name()
ops = bpy.ops.fit_flare
scene = bpy.context.scene
ops.import_capture(directory=str(capture))
os.environ["FIT_FLARE_ENGINE"] = sys.executable
scene.fit_flare.mode = "estimated"
facts["fit without weights"] = fits.why_not_fit(scene)
facts["cleaning without weights"] = refusal(ops.clean_frames)
scene.fit_flare.mode = "split"
facts["fit by parallax"] = fits.why_not_fit(scene)
del os.environ["FIT_FLARE_ENGINE"]
with patch.object(part("flare_addon.jobs"), "start_job") as start:
    engine.set_up_engine()
    facts["set-up brings them"] = "--weights" in start.call_args.args[2]
facts["the preferences offer them"] = "fit_flare.download_weights" in drawn(preferences.FITFLARE_AP_preferences)
system.use_online_access = False
facts["offline"] = [refusal(ops.download_weights), refusal(ops.set_up_engine)]
system.use_online_access = True
ops.download_weights()
facts["downloaded"] = [weights.download_job().state, weights.download_job().error,
                       weights.find_weights() == weights.downloaded_file(),
                       weights.environment() == {"FIT_FLARE_WEIGHTS": str(weights.downloaded_file())}]
facts["the preferences name them"] = str(weights.downloaded_file()) in drawn(preferences.FITFLARE_AP_preferences)
scene.fit_flare.mode = "estimated"
os.environ["FIT_FLARE_ENGINE"] = sys.executable
facts["fit with weights"] = fits.why_not_fit(scene)
with patch.object(part("flare_addon.jobs"), "start_job") as start:
    engine.run("clean", out, ["remove"])
    facts["passed to the engine"] = start.call_args.args[3]["FIT_FLARE_WEIGHTS"] == str(weights.downloaded_file())
own = out / "own.safetensors"
own.touch()
bpy.context.preferences.addons["bl_ext.ours.fit_flare"].preferences.weights = str(own)
facts["those of the preferences"] = weights.find_weights() == own
own.unlink()
facts["those of the preferences are missing"] = weights.missing_reason()
leave(facts)
