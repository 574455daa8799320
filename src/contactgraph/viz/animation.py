"""Animations of a trajectory: GIF always, MP4 if ffmpeg is installed."""

import importlib
import importlib.util
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from contactgraph.data import InvalidInputError, atomic_write
from contactgraph.viz.scene_picture import INK, SOFT, draw_scene
from contactgraph.viz.scene_trajectory import SceneTrajectory

_FRAME_SECONDS = 0.04
"""Least time between frames; viewers show a GIF not much faster."""
_SIDE_INCHES, _HEAD_INCHES, _DOTS_PER_INCH = 4.8, 0.4, 100


def write_animation(path: str | Path, scene: SceneTrajectory) -> None:
    """Write ``scene`` in real time to a ``.gif`` or ``.mp4`` file, atomically.

    Raises `InvalidInputError` as `check_animation` does.
    """
    path = Path(path)
    check_animation(path)
    program = _ffmpeg(path) if path.suffix.lower() == ".mp4" else ""
    states = frame_states(scene)
    seconds = scene.dt * states.step
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        if program:
            _write_mp4(temporary, frames(scene, states), seconds, program)
        else:
            _write_gif(temporary, frames(scene, states), seconds)


def check_animation(path: Path) -> None:
    """Raise `InvalidInputError` for an unknown extension, or ``.mp4`` without ffmpeg."""
    ending = path.suffix.lower()
    if ending not in (".gif", ".mp4"):
        raise InvalidInputError(f"video: {path} must end in .gif or .mp4, found {ending!r}")
    if ending == ".mp4":
        _ffmpeg(path)


def frame_states(scene: SceneTrajectory) -> range:
    """The states to draw: all, or every n-th if they are closer in time than frames."""
    return range(0, scene.steps + 1, max(1, round(_FRAME_SECONDS / scene.dt)))


def frames(scene: SceneTrajectory, states: Iterable[int]) -> Iterator[np.ndarray]:
    """[height, width, 3] uint8, one a state."""
    height = _SIDE_INCHES + _HEAD_INCHES
    figure = Figure(figsize=(_SIDE_INCHES, height), dpi=_DOTS_PER_INCH, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.96 * _SIDE_INCHES / height))
    # Names are user input: a dollar sign must not be parsed as mathematics.
    figure.text(0.02, 0.955, scene.name, color=INK, fontsize=11, weight="bold", parse_math=False)
    time = figure.text(0.98, 0.955, "", color=SOFT, fontsize=11, ha="right")
    for state in states:
        for artist in (*axes.lines, *axes.artists, *axes.patches):
            artist.remove()
        draw_scene(axes, scene, state)
        time.set_text(f"{state * scene.dt:.2f} s")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _write_gif(path: Path, frames: Iterator[np.ndarray], seconds: float) -> None:
    """One palette for all frames, made of the last, which contains every colour."""
    pictures = [Image.fromarray(frame) for frame in frames]
    palette = pictures[-1].quantize(128, method=Image.Quantize.MEDIANCUT)
    first, *rest = (one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures)
    milliseconds = max(20, round(1000 * seconds))
    first.save(path, "GIF", save_all=True, append_images=rest, duration=milliseconds, loop=0)


def _write_mp4(path: Path, frames: Iterator[np.ndarray], seconds: float, program: str) -> None:
    """H.264 with even sides and the pixel format that browsers play."""
    first = next(frames)
    size = f"{first.shape[1]}x{first.shape[0]}"
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{1.0 / seconds:.6g}"]
    made = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-c:v", "libx264"]
    command = [program, "-loglevel", "error", "-y", *raw, "-i", "-", *made, "-f", "mp4", str(path)]
    pictures = b"".join([first.tobytes(), *(frame.tobytes() for frame in frames)])
    done = subprocess.run(command, input=pictures, capture_output=True, check=False)
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise RuntimeError(f"ffmpeg ({program}) failed: {said[-1] if said else done.returncode}")


def _ffmpeg(path: Path) -> str:
    """The path of ffmpeg: on PATH, or in the imageio-ffmpeg package."""
    program = shutil.which("ffmpeg")
    if program is None and importlib.util.find_spec("imageio_ffmpeg") is not None:
        program = str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    if program is None:
        raise InvalidInputError(
            f"video: {path} needs ffmpeg, which was not found: "
            "pip install imageio-ffmpeg, or name a .gif file"
        )
    return program
