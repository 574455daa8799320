"""The live page in a headless Chromium: pictures a second, and the lag of a drag.

The lag is the time from a drag of the goal, in the page, to the picture of the first plan that
knows of it. Needs Chromium, `pip install 'contactgraph[play,mujoco]'`, and nothing else that runs
on the machine.
"""

import argparse
import asyncio
import json
import sys
import threading
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "play"))
from devtools import CHROMIUM, Browser, browser  # noqa: E402

from contactgraph.cli.play import stage_parts  # noqa: E402
from contactgraph.play import Session, StageChoice  # noqa: E402
from contactgraph.play.server import listening_socket, origin_of, serve_session  # noqa: E402

CASES = {
    "pickup, 10 objects": (StageChoice("pickup", "pickup", 9), 40.0, 60.0),
    "franka": (StageChoice("franka", "franka", 0), 20.0, 35.0),
}
"""Asked pictures a second, and the aim."""
LAG_MS = 150.0, 80.0
DRAGS = 40
CANVAS = "document.getElementById('scene')"
DRAG = f"""(() => {{
  const canvas = {CANVAS};
  const box = canvas.getBoundingClientRect();
  const {{ rim, goal }} = JSON.parse(canvas.dataset.at);
  return [box.left + rim[0], box.top + rim[1], box.left + goal[0], box.top + goal[1]];
}})()"""


def measure(choice: StageChoice, seconds: float) -> dict[str, float]:
    session = Session(choice, stage_parts, (choice.model,), (choice.task,))
    listening = listening_socket(0)
    server = threading.Thread(target=lambda: asyncio.run(serve_session(session, listening)))
    session.start()
    server.start()
    try:
        with browser() as page:
            page.open(origin_of(listening) + "/")
            page.until(f"Number({CANVAS}.dataset.frames ?? 0) > 30", 900)
            frames, begin = count(page), time.perf_counter()
            time.sleep(seconds)
            rate = (count(page) - frames) / (time.perf_counter() - begin)
            lags = [lag(page, number) for number in range(DRAGS)]
            step_ms = float(page.text("#median-ms"))
    finally:
        session.stop()
        server.join()
    p50, p95 = np.percentile(lags, [50, 95])
    return {"frames_s": rate, "lag_ms_p50": p50, "lag_ms_p95": p95, "step_ms_p50": step_ms}


def count(page: Browser) -> int:
    return int(page.value(f"Number({CANVAS}.dataset.frames)"))


def lag(page: Browser, number: int) -> float:
    """ms, of one drag by a few pixels there or back."""
    known = page.value(f"Number({CANVAS}.dataset.lags ?? 0)")
    x, y, _, _ = page.value(DRAG)
    page.mouse("mousePressed", (x, y))
    page.mouse("mouseMoved", (x + (4 if number % 2 else -4), y))
    page.until(f"Number({CANVAS}.dataset.lags ?? 0) > {known}")
    page.mouse("mouseReleased", (x + (4 if number % 2 else -4), y))
    time.sleep(0.05)
    return float(page.value(f"{CANVAS}.dataset.lag"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of counting pictures, a case")
    parser.add_argument("--only", choices=CASES, help="this case alone")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    options = parser.parse_args()
    if CHROMIUM is None:
        parser.error("chromium was not found")
    results = {}
    print("| scene | pictures/s | asked, aim | lag, median (95 %), ms | asked, aim | step, ms |")
    print("|---|---|---|---|---|---|")
    for name, (choice, asked, aim) in CASES.items():
        if options.only in (None, name):
            found = results[name] = measure(choice, options.seconds)
            print(
                f"| {name} | {found['frames_s']:.1f} | {asked:g}, {aim:g} "
                f"| {found['lag_ms_p50']:.0f} ({found['lag_ms_p95']:.0f}) "
                f"| {LAG_MS[0]:g}, {LAG_MS[1]:g} | {found['step_ms_p50']:.1f} |",
                flush=True,
            )
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
