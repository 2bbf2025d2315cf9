# SPDX-License-Identifier: GPL-3.0-or-later
"""People come in through Blender's menus, its search, dropped files and the handbook."""
from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from blenders import ROOT

from headless.handbook import render_pages

BLENDERS_LABELS = {"Online Manual", "Install from Disk", "Add Remote Repository", "Color Management",
                   "Crop to Render Region", "Disable in Renders", "Disable in Viewports", "Ray Visibility", "Stereo 3D",
                   "Multi-View", "Spherical Stereo", "Adjust Last Operation", "View as Render", "Step",
                   "Render Viewport Preview", "Render Playblast"}
NO_LABELS = {"+", "Follow", "Memory", "Black borders", "White balance", "Motion blur, rolling shutter"}
"""A button without a label, the beginning of several labels, and subjects of rows and sections."""


@pytest.fixture(scope="session")
def facts(run_script: Callable[[str, int], Any]) -> Any:
    return run_script("doors", 3)


def test_the_menus_of_blender_have_entries(facts: Any) -> None:
    """Block of doors.py: "menus"."""
    assert all(len(functions) == 1 for functions in facts["menus"].values())
    assert facts["import"] == [["fit_flare.import_capture", "Fit Flare Capture (.json, COLMAP)"],
                               ["fit_flare.open_flare", "Flare (.flare)"]]
    assert facts["render"] == [["fit_flare.bake", "Bake and Composite Flares"]]


def test_the_context_menu_of_a_lamp_adds_and_chooses_its_flare(facts: Any) -> None:
    """Block of doors.py: "menus"."""
    assert facts["of a mesh"] == []
    assert facts["of a lamp"] == ["fit_flare.add_library_flare"]
    assert facts["of a lamp with a flare"] == ["fit_flare.add_library_flare", "fit_flare.choose_flare"]
    assert facts["chosen"] == "Lamp 1"
    drawn, refused = facts["no flare yet"]
    assert drawn == [] and "The active object has no flare" in refused


def test_the_search_finds_the_work_by_its_words(facts: Any) -> None:
    """Block of doors.py: "menus"."""
    assert {"Add Lens Flare", "Use This Look", "Open Flare", "Make from Lens", "Flare from Selected",
            "Pick Light in Picture", "Pick Element", "Reset Look", "Import Capture", "Find in Frames",
            "Flare from Footage", "Fit", "Make Clean Frames", "Single Picture", "Bake and Composite Flares",
            "Set Up Compositor", "Remove from Compositor", "Save to Library", "Fit Flare Handbook"
            } <= set(facts["words"])
    assert facts["adds at selected"] == [True, False], "only the first look of a scene"
    assert facts["unknown"] == []


def test_files_are_imported_and_dropped(facts: Any) -> None:
    """Block of doors.py: "files that are dropped or imported"."""
    assert facts["handlers"] == {"Fit Flare Capture": ["fit_flare.import_capture", ".json;.bin"],
                                 "Fit Flare Look": ["fit_flare.open_flare", ".flare"]}
    assert facts["dropped on"] == [True, False]
    assert facts["a file of a capture"] == [["FINISHED"], True]
    assert facts["a flare"] == [["FINISHED"], 1]


def test_every_panel_links_a_page_of_the_handbook(facts: Any) -> None:
    """Block of doors.py: "links to the handbook"."""
    pages = facts["pages"]
    assert {name: page for name, page in pages.items() if not page} == {}
    assert {"FITFLARE_PT_library", "FITFLARE_PT_node_look", "FITFLARE_PT_image_picture", "FITFLARE_PT_clip_lights"
            } <= set(pages)
    assert (pages["FITFLARE_PT_image_picture"], pages["FITFLARE_PT_clip_lights"]) == ("transfer", "first_fit")
    assert facts["index"] == [True, False]


def test_the_online_manual_of_each_operator_is_a_page_that_names_it(facts: Any) -> None:
    """By its label, or by the text of its button.

    Block of doors.py: "links to the handbook".
    """
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "flare_addon").rglob("*.py")]
    texts = re.findall(r'operator\(\s*"fit_flare\.(\w+)"[^)]*?text="([^"]+)"', "\n".join(sources))
    pages = {path.stem: path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "handbook").glob("*.md")}
    operators = facts["operators"]
    assert len(operators) > 40 and facts["topics"] and facts["stray topics"] == []
    unnamed = {name: page for name, (label, page) in operators.items()
               if not any(f"**{text}**" in pages[page] for text in (
                   label, *(text for operator, text in texts if operator == name)))}
    assert unnamed == {}


def test_the_online_manual_of_each_property_is_the_page_about_its_panel(facts: Any) -> None:
    """Block of doors.py: "links to the handbook"."""
    pages = facts["pages of properties"]
    assert len(pages) > 50 and set(pages.values()) == {"install", "first_fit", "transfer", "editing"}
    for name, page in {"ap_preferences.engine": "install", "ap_preferences.library": "transfer",
                       "pg_scene.preset": "first_fit", "pg_scene.over": "editing",
                       "pg_light.follow_power": "editing"}.items():
        assert pages[name] == page, name


def test_the_labels_in_the_handbook_are_those_of_the_interface() -> None:
    """Bold and italic words are labels."""
    literals = {node.value.strip(" .") for path in (ROOT / "flare_addon").rglob("*.py")
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    for page in (ROOT / "docs" / "handbook").glob("*.md"):
        text = re.sub("`[^`]*`", "", page.read_text(encoding="utf-8"))
        labels = {bold or italic for bold, italic in re.findall(r"\*\*([^*\n]+)\*\*|\*([^*\n]+)\*", text)}
        assert labels - literals - BLENDERS_LABELS - NO_LABELS == set(), page.name


def test_panels_draw_without_a_clip_a_flare_or_a_node(facts: Any) -> None:
    """Blocks of doors.py: "what panels draw", "bake and composite"."""
    without, flared = facts["drawn without a flare"], facts["drawn with a flare"]
    assert facts["drawn with a node"] == flared
    assert without["node_look"] == without["node_bake"] == [True, False]
    assert without["image_look"] == without["image_bake"] == [False, False, False]
    assert flared["image_look"] == flared["image_bake"] == [True, True, True]
    assert without["image_picture"] == flared["image_picture"] == [False, True, False]
    assert without["clip_lights"] == flared["clip_lights"] == [True, True]
    assert without["look"] == flared["look"] == [True]


def test_headings_separate_the_sliders_of_all_flares_of_a_light_and_of_an_element(facts: Any) -> None:
    """Block of doors.py: "what panels draw"."""
    drawn, light, element = facts["headings"]
    sliders = [(drawn[index - 1], subject) for index, subject in enumerate(drawn) if subject.endswith(".intensity")]
    assert sliders == [("All Flares", "FITFLARE_PG_master.intensity"), (light, "FITFLARE_PG_light.intensity"),
                       (element.capitalize(), "FITFLARE_PG_element.intensity")]


def test_one_button_bakes_and_composites(facts: Any) -> None:
    """Block of doors.py: "bake and composite"."""
    assert facts["button"] == ["Bake and Composite", ""]
    assert facts["one button"] == [True, True]
    assert facts["anew"] == [True, 1], "a bake alone leaves the compositor as it is"


def test_links_of_the_handbook_lead_to_its_pages() -> None:
    pages = render_pages(ROOT / "docs" / "handbook")
    for name, content in pages.items():
        if name.endswith(".html"):
            text = content.decode()
            targets = [part.split('"')[0] for mark in ('href="', 'src="') for part in text.split(mark)[1:]]
            for target in targets:
                page, _, anchor = target.partition("#")
                assert (page or name) in pages, (name, target)
                assert not anchor or f'id="{anchor}"' in pages[page or name].decode(), (name, target)
            assert "**" not in text and "](" not in text, name


def test_the_handbook_keeps_code_and_drops_links_that_leave_it(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "README.md").write_text("# A & B\n\nSee [there](../x.md) and `a*b*c`, **bold** *this*.\n\n"
                                        "| a | b |\n| --- | --- |\n| 1 | `2` |\n\n1. one\n2. two\n\nThen:\n\n"
                                        "    code <x>\n")
    page = re.sub(r"\n|</?t(head|body)>", "", render_pages(tmp_path)["index.html"].decode())
    assert "<h1 id=\"a--b\">A &amp; B</h1>" in page
    assert "See there and <code>a*b*c</code>, <strong>bold</strong> <em>this</em>." in page
    assert "<tr><th>a</th><th>b</th></tr><tr><td>1</td><td><code>2</code></td></tr>" in page
    assert "<ol><li>one</li><li>two</li></ol>" in page and "<pre>code &lt;x&gt;</pre>" in page
