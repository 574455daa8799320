"""The page in a headless browser: a mouse drags, and the session answers."""

import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from devtools import CHROMIUM, browser

from contactgraph.data import read_trajectories

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the chromium browser"),
]

CANVAS = "document.getElementById('scene')"
FRAMES = f"Number({CANVAS}.dataset.frames ?? 0)"
PLACE = """(() => {{
  const canvas = document.getElementById("scene");
  const box = canvas.getBoundingClientRect();
  const {{ at }} = canvas.dataset;
  const [x, y] = JSON.parse(at)[{0}];
  return [box.left + x, box.top + y];
}})()"""


@pytest.fixture(scope="module")
def page(served):
    with browser() as opened:
        opened.open(served.origin + "/")
        opened.until(f"{FRAMES} > 2", 180)
        yield opened
        assert opened.complaints == []
        here = (f"{served.origin}/", served.origin.replace("http", "ws") + "/session", "data:,")
        assert set(opened.requests) <= set(here), "no request leaves the machine"
        assert here[0] in opened.requests


def place(page, name):
    """Of a handle in the window, px: the number of a body, or the goal."""
    x, y = page.value(PLACE.format(f'"{name}"'))
    return x, y


def begin(page):
    """A new scene."""
    number = page.value(f"{CANVAS}.dataset.scene")
    page.click("#reset")
    page.until(f"{CANVAS}.dataset.scene !== '{number}'")


def test_a_dragged_goal_is_reached(page):
    begin(page)
    rim, middle = place(page, "rim"), place(page, "goal")
    aside = place(page, "middle")
    page.drag(rim, (aside[0] + rim[0] - middle[0], aside[1] + rim[1] - middle[1]))
    assert math.dist(place(page, "goal"), aside) < 3.0
    moved = page.value(f"JSON.parse({CANVAS}.dataset.at).goal")
    page.until("document.getElementById('goal-name').textContent.includes('reached')")
    assert math.dist(page.value(f"JSON.parse({CANVAS}.dataset.at).goal"), moved) < 3.0
    assert float(page.value("document.getElementById('scene').dataset.lag")) > 0.0


def test_a_pushed_body_moves(page):
    begin(page)
    start, aside = place(page, 1), place(page, "middle")
    page.drag(start, aside, 20, lambda: time.sleep(0.6))
    assert math.dist(place(page, 1), start) > 0.2 * math.dist(aside, start)


def test_a_broken_sensor_is_seen_in_the_belief(page):
    begin(page)
    page.click("#sensor label:nth-of-type(2)")
    belief = "Number(document.querySelector('#belief-plots .ink-belief').textContent)"
    page.until(f"document.querySelector('#belief-plots .band') && {belief} < 0.5")
    page.click("#sensor label:nth-of-type(1)")
    page.until("document.querySelector('#sensor input').checked")


def test_bodies_are_added_and_taken_away(page):
    page.click("#more")
    page.until("document.getElementById('distractors').textContent === '1'", 300)
    page.until("document.getElementById('scene-legend').textContent.includes('one distractor')")
    page.click("#fewer")
    page.until("document.getElementById('distractors').textContent === '0'", 300)


def test_the_page_fits_a_narrow_window(served, page):
    page.open(served.origin + "/", 380, 800)
    page.until(f"{FRAMES} > 2")
    assert page.value("document.documentElement.scrollWidth") <= 380


def test_ctrl_c_keeps_what_was_recorded(tmp_path: Path):
    record = tmp_path / "session.h5"
    command = [sys.executable, "-m", "contactgraph", "play", "--record", str(record)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    with browser() as opened:
        opened.open(url)
        opened.until(f"{FRAMES} > 20", 300)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    (episode,) = read_trajectories(record)
    assert episode.steps > 5
