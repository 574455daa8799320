"""The process of the camera: ``python -m contactgraph_franka.sim.camera_process FOLDER``."""

import math
import os
import sys
import time
from pathlib import Path

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.engine import mujoco
from contactgraph_franka.loop.undisturbed import give_way
from contactgraph_franka.sim.frames import FrameWriter
from contactgraph_franka.sim.rendered_camera import RenderedCamera
from contactgraph_franka.sim.server_report import read_places
from contactgraph_franka.sim.session import read_session
from contactgraph_franka.sim.truth import Truth

_BEHIND = 5
"""How much this process yields to those that must be on time."""
_LOOKS, _HULLS, _SHOWN, _HIDDEN = 2, 3, 0, 4
"""Groups of shapes: those for looks, and the coarser ones that collide."""


def main() -> None:
    """Takes pictures until the owner ends."""
    folder = Path(sys.argv[1])
    session = read_session(folder)
    settings = session.camera
    if settings is None:
        raise InvalidInputError("this rehearsal has no camera")
    give_way(_BEHIND)
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    # The hand must hide what it hides; drawn with its maker's surfaces it takes twice as long.
    group = model.geom_group
    group[group == _LOOKS] = _HIDDEN
    group[group == _HULLS] = _SHOWN
    camera = RenderedCamera(
        model,
        settings.pose,
        settings.intrinsics,
        grey_noise=settings.grey_noise,
        depth_noise=settings.depth_noise,
        bodies=[f"block{index}" for index in range(session.blocks)],
        seed=settings.seed,
    )
    truth = Truth(folder, session.blocks, read_places(folder))
    frames = FrameWriter(folder, settings.intrinsics, settings.depth_noise is not None)
    _film(camera, truth, frames, session.pace, settings.rate, settings.delay)


def _film(
    camera: RenderedCamera,
    truth: Truth,
    frames: FrameWriter,
    pace: float,
    rate: float,
    delay: float,
) -> None:
    """Takes ``rate`` frames a second of the reader's clock; each can be had ``delay`` s later."""
    owner = os.getppid()
    number = math.ceil(time.monotonic() / pace * rate)
    while os.getppid() == owner:
        _sleep_until(number / rate * pace)
        now = truth.newest()
        picture = camera.picture(now["places"], float(now["stamp"]))
        _sleep_until((picture.time + delay) * pace)
        frames.publish(picture)
        following = max(number + 1, math.ceil(time.monotonic() / pace * rate))
        frames.miss(following - number - 1)
        number = following


def _sleep_until(moment: float) -> None:
    """``moment`` s on the wall's clock."""
    time.sleep(max(0.0, moment - time.monotonic()))


if __name__ == "__main__":
    main()
