import dataclasses
import json
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image
from test_report_page import bare

from contactgraph.viz import ReportData
from contactgraph.viz.report import page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
GRIPPER = np.array([0x1B, 0x66, 0xA8])
TOUCH = np.array([0x76, 0x50, 0xA3])
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the chromium browser"),
]


def screenshot(folder, data, acting=""):
    """The page as pixels [height, width, 3], and what the browser's console said.

    ``acting`` is a script that handles the page as a reader would, for which its policy is lifted.
    """
    text = page(data)
    if acting:
        text = text.replace('http-equiv="Content-Security-Policy"', "")
        text = text.replace("</body>", f"<script>{acting}</script></body>")
    (folder / "index.html").write_text(text, encoding="utf-8")
    picture = folder / "page.png"
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--enable-logging=stderr",
        "--v=0",
        "--force-prefers-reduced-motion",
        "--window-size=1000,1700",
    ]
    done = subprocess.run(
        [
            CHROMIUM,
            *flags,
            f"--user-data-dir={folder / 'profile'}",
            f"--screenshot={picture}",
            f"file://{folder / 'index.html'}",
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return np.asarray(Image.open(picture).convert("RGB")).astype(int), said


def pixels_of(picture, colour):
    return int(np.sum(np.abs(picture - colour).sum(axis=-1) < 12))


def test_browser_draws_the_bodies_without_a_complaint(tmp_path, data):
    picture, said = screenshot(tmp_path, data)
    assert said == []
    assert pixels_of(picture[:, :480], GRIPPER) > 150, "the gripper's ring and trail"


def test_browser_draws_inferred_types_beside_the_true_ones(tmp_path, data):
    """One strip of eight has a touch, the true one of the first edge; it is a third of it."""
    picture, said = screenshot(tmp_path, dataclasses.replace(data, scenes=()))
    assert said == []
    touch = np.abs(picture - TOUCH).sum(axis=-1) < 12
    rows = np.flatnonzero(touch[:, 600:].sum(axis=1) > 200)
    assert len(rows) == rows[-1] - rows[0] + 1 == 13


def test_browser_draws_a_lone_body(tmp_path, scene):
    picture, said = screenshot(tmp_path, ReportData("One body", "alone", scenes=(bare(scene, 1),)))
    assert said == []
    assert pixels_of(picture[:, :480], GRIPPER) > 100


def test_browser_page_answers_its_controls(tmp_path, data):
    """The second scene, near the grasp, by keyboard and by a pointer over a plot."""
    acting = """
    const choose = (id) => [...document.querySelectorAll(`#${id} input`)][1].click();
    choose("scene-choice");
    choose("span-choice");
    const now = () => document.getElementById("now").textContent;
    const press = (key) =>
      document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
    const button = document.getElementById("play");
    press(" ");
    const plays = button.getAttribute("aria-label") === "Pause";
    press(" ");
    const before = now();
    press("ArrowRight");
    const after = now();
    const slider = document.getElementById("time");
    slider.value = 20;
    slider.dispatchEvent(new Event("input"));
    const slid = now();
    const plot = document.querySelector("#parameter-plots svg");
    const box = plot.getBoundingClientRect();
    plot.dispatchEvent(new PointerEvent("pointermove", { clientX: box.right - 6, bubbles: true }));
    console.log(JSON.stringify({ plays, before, after, slid, hovered: now() }));
    """
    _, said = screenshot(tmp_path, data, acting)
    assert len(said) == 1, said
    found = json.loads(said[0][said[0].index("{") : said[0].rindex("}") + 1].replace('\\"', '"'))
    assert found["plays"]
    step = float(found["after"][:-2]) - float(found["before"][:-2])
    assert step == pytest.approx(0.05)
    assert found["slid"] == "1.00 s"
    grasp = int(np.argmax(data.scenes[1].contact[:, 0])) * 0.05
    assert float(found["hovered"][:-2]) == pytest.approx(grasp + 1.0, abs=0.011)
