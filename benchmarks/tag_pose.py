"""Accuracy of a tagged block's pose from a rendered camera, at rest and in motion.

Usage: python benchmarks/tag_pose.py [--quick] [--json FILE]

Needs the extras ``robot`` and ``mujoco``, and OpenGL without a screen. A block of 0.04 x 0.04 x 0.1
m with nine tags is put anywhere in the arm's region, turned and tilted; the camera stands opposite
the arm, with 1280 x 720 px, a focal length of 900 px and noise of 2 grey levels. Depth has 3 mm of
noise a pixel and an error of 0.3 % that all pixels of a frame share. The calibrated rows use the
camera's pose as `calibrate` finds it from 20 pictures of the block in a hand whose own poses are
0.3 mm and 0.05 degrees off.

Then the block accelerates from rest to 0.5 m/s in 0.3 s, along four paths; frames come at 30 Hz, 30
ms late, and the tracker estimates the position every 2 ms. Last, a loop of 1 kHz runs alone, beside
a detection thread at 30 Hz, and beside a detection process.
"""

import os
import sys
from importlib.util import find_spec

os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo takes its OpenGL as it is imported
if find_spec("mujoco") is None or find_spec("pyapriltags") is None:
    print("tag_pose is left out: it needs pip install 'contactgraph[mujoco,robot]'")
    sys.exit()

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np
from measuring import arguments, report, table

from contactgraph_franka.envs.arm_model import mujoco
from contactgraph_franka.perception import (
    CameraCalibration,
    CameraFrame,
    Intrinsics,
    ObjectTracker,
)
from contactgraph_franka.perception.camera import pose, rotation_of
from contactgraph_franka.perception.detector import ObjectDetector, estimate_pose
from contactgraph_franka.perception.hand_eye import HandEye, calibrate
from contactgraph_franka.perception.object_pose import ObjectPose
from contactgraph_franka.perception.perception import Perception
from contactgraph_franka.perception.tags import TagDetector
from contactgraph_franka.perception.tracked_objects import TrackedObjects
from contactgraph_franka.sim.blocks import TaggedBlock, tagged_block
from contactgraph_franka.sim.rendered_camera import RenderedCamera

LENS = Intrinsics(900.0, 900.0, 639.5, 359.5, 1280, 720)
LOW, HIGH = np.array([0.3, -0.35, 0.05]), np.array([0.7, 0.35, 0.35])
TILT = 0.15
"""rad, standard deviation about each horizontal axis."""
DEPTH_NOISE, DEPTH_ERROR = 0.003, 0.003
RATE, DELAY = 30.0, 0.03
SCENE = """<mujoco><worldbody><geom type="plane" size="3 3 .1" rgba=".45 .5 .55 1"/>
<light pos="0 0 3" dir="0 0 -1" directional="true"/></worldbody></mujoco>"""


def scene() -> tuple[Any, TaggedBlock]:
    tree = ElementTree.fromstring(SCENE)
    block = tagged_block("block", np.array([0.5, 0.0, 0.05]))
    block.append_to(tree)
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(tree, encoding="unicode")), block


def camera_pose() -> np.ndarray:
    eye, at = np.array([1.25, 0.0, 0.55]), np.array([0.45, 0.0, 0.15])
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return pose(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


def free_body_state(place: np.ndarray) -> np.ndarray:
    """A pose [4, 4] as MuJoCo's ``qpos`` [7]."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(place[:3, :3]).ravel())
    return np.concatenate([place[:3, 3], quaternion])


def anywhere(rng: np.random.Generator) -> np.ndarray:
    tilt = rng.normal(0.0, TILT, 3) * (1.0, 1.0, 0.0)
    turn = rotation_of(tilt) @ rotation_of(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    return pose(turn, rng.uniform(LOW, HIGH))


class Bench:
    """A camera, a block, and the detector of its pose."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        model, block = scene()
        self.tagged = block.tagged
        self.camera = RenderedCamera(model, camera_pose(), LENS, depth_noise=DEPTH_NOISE, seed=seed)
        self.detector = TagDetector([tuple(self.tagged.by_id)])

    def frame(self, place: np.ndarray, moment: float = 0.0) -> CameraFrame:
        taken = self.camera.picture(free_body_state(place), moment)
        assert taken.depth is not None
        scale = np.float32(1.0 + DEPTH_ERROR * self.rng.standard_normal())
        return replace(taken, depth=taken.depth * scale)

    def detect(self, frame: CameraFrame) -> tuple[ObjectPose | None, float]:
        """The detected pose in a frame, and the seconds taken."""
        began = time.perf_counter()
        found = estimate_pose(frame, self.detector.detect(frame.image), self.tagged, LENS)
        return found, time.perf_counter() - began


def calibration(bench: Bench) -> HandEye:
    """Calibration from 20 tilted poses of a hand that holds the block, with small errors."""
    in_hand = pose(rotation_of(np.array([np.pi, 0.1, 0.2])), np.array([0.01, 0.0, 0.03]))
    hands, sightings = [], []
    while len(hands) < 20:
        turn = rotation_of(bench.rng.normal(0.0, 0.35, 3))
        place = pose(turn, bench.rng.uniform(LOW + np.array([0.0, 0.0, 0.1]), HIGH))
        found, _ = bench.detect(replace(bench.frame(place), depth=None))
        if found is None:
            continue
        off = pose(
            rotation_of(bench.rng.normal(0.0, np.radians(0.05), 3)),
            bench.rng.normal(0.0, 0.3e-3, 3),
        )
        hands.append(place @ np.linalg.inv(in_hand) @ off)
        sightings.append(found)
    return calibrate(np.array(hands), sightings, bench.tagged, LENS)


def at_rest(bench: Bench, count: int, hand_eye: HandEye) -> Iterator[dict[str, Any]]:
    """Rows: errors over random poses, each in a frame that was not searched before."""
    errors: dict[str, list[float]] = {}
    spreads: dict[str, list[float]] = {}
    took: list[float] = []
    for _ in range(count):
        place = anywhere(bench.rng)
        frame = bench.frame(place)
        for kind, taken, camera in (
            ("corners and edges", replace(frame, depth=None), bench.camera.pose),
            ("with depth", frame, bench.camera.pose),
            ("calibrated", replace(frame, depth=None), hand_eye.camera_pose),
            ("calibrated, depth", frame, hand_eye.camera_pose),
        ):
            found, seconds = bench.detect(taken)
            if found is None:
                continue
            if kind == "with depth":  # search windows come from the frame before, as in a stream
                took.append(seconds)
            measured = camera @ found.pose
            errors.setdefault(kind, []).append(
                1e3 * float(np.linalg.norm(measured[:3, 3] - place[:3, 3]))
            )
            apart = measured[:3, :3] @ place[:3, :3].T
            angle = np.arccos(np.clip((np.trace(apart) - 1.0) / 2.0, -1.0, 1.0))
            spreads.setdefault(kind, []).append(float(np.degrees(angle)))
    for kind, values in errors.items():
        yield {
            "seen by": kind,
            "poses": count,
            "found %": 100.0 * len(values) / count,
            "median mm": float(np.median(values)),
            "p95 mm": float(np.percentile(values, 95)),
            "worst mm": max(values),
            "median deg": float(np.median(spreads[kind])),
            "ms a frame": 1e3 * float(np.median(took)),
        }


def in_motion(bench: Bench, hand_eye: HandEye | None) -> dict[str, Any]:
    """A row: errors of the tracker's current estimate, over picks along four paths."""
    camera = bench.camera.pose if hand_eye is None else hand_eye.camera_pose
    position, speed = [], []
    frames = 0
    for number, bearing in enumerate(np.radians([0.0, 90.0, 180.0, 270.0])):
        turn = rotation_of(np.array([0.0, 0.0, 0.3 + number]))
        start, way = np.array([0.5, 0.0, 0.06]), np.array([np.cos(bearing), np.sin(bearing), 0.3])
        way /= np.linalg.norm(way)
        begin = 0.5 + bench.rng.uniform(0.0, 1.0 / RATE)
        tracker, coming = ObjectTracker(), []
        for index in range(int(1.2 * RATE)):
            moment = index / RATE
            place = pose(turn, start + way * _way(moment - begin)[0])
            found, _ = bench.detect(bench.frame(place, moment))
            if found is not None:
                spread = camera[:3, :3] @ found.covariance[3:, 3:] @ camera[:3, :3].T
                coming.append((moment, (camera @ found.pose)[:3, 3], spread))
        frames += len(coming)
        for now in np.arange(0.3, 1.2, 0.002):
            while coming and coming[0][0] + DELAY <= now:
                moment, measured, spread = coming.pop(0)
                tracker.measure(measured, spread, moment)
            gone, fast = _way(now - begin)
            estimate = tracker.estimate(now)
            position.append(1e3 * np.linalg.norm(estimate.position - start - way * gone))
            speed.append(np.linalg.norm(estimate.velocity - way * fast))
    return {
        "moving": "true camera" if hand_eye is None else "calibrated",
        "frames": frames,
        "position rms mm": float(np.sqrt(np.mean(np.square(position)))),
        "p95 mm": float(np.percentile(position, 95)),
        "worst mm": float(max(position)),
        "velocity rms m/s": float(np.sqrt(np.mean(np.square(speed)))),
        "worst m/s": float(max(speed)),
    }


def _way(since: float) -> tuple[float, float]:
    """Distance m and speed m/s, ``since`` s after the start: from rest to 0.5 m/s within 0.3 s."""
    speeding = float(np.clip(since, 0.0, 0.3))
    acceleration = 0.5 / 0.3
    gone = 0.5 * acceleration * speeding**2 + 0.5 * max(since - 0.3, 0.0)
    return gone, acceleration * speeding


class Replay:
    """A camera that repeats one frame at 30 Hz."""

    intrinsics = LENS

    def __init__(self, image: np.ndarray) -> None:
        self._image, self._next = image, time.monotonic()

    def read(self) -> CameraFrame | None:
        now = time.monotonic()
        if now < self._next:
            return None
        self._next = max(self._next + 1.0 / RATE, now)
        return CameraFrame(self._image, None, now)

    def close(self) -> None:
        pass


def loop(cycles: int, each: Callable[[], object]) -> np.ndarray:
    """[cycles] ms of delay of each cycle of a loop of 1 kHz."""
    late, due = np.empty(cycles), time.monotonic()
    for cycle in range(cycles):
        due += 0.001
        time.sleep(max(0.0, due - time.monotonic()))
        late[cycle] = 1e3 * (time.monotonic() - due)
        each()
        due = max(due, time.monotonic() - 0.001)
    return late


def beside(bench: Bench, cycles: int) -> Iterator[dict[str, Any]]:
    """Rows: delays of cycles without and with detection in parallel."""
    taken = bench.frame(pose(np.eye(3), np.array([0.5, 0.0, 0.05])))
    known = CameraCalibration(
        LENS, bench.camera.pose, {"block": bench.tagged}, "2026-01-01T00:00:00+00:00"
    )
    yield _lateness("alone", loop(cycles, lambda: None))
    ended = threading.Event()
    thread = threading.Thread(target=_watching, args=(Replay(taken.image), known, ended))
    thread.start()
    yield _lateness("a thread", loop(cycles, lambda: None))
    ended.set()
    thread.join()
    with Perception(partial(Replay, taken.image), known) as seeing:
        objects = TrackedObjects(seeing, ("block",))
        yield _lateness("a process", loop(cycles, lambda: objects.estimates(time.monotonic())))


def _watching(camera: Replay, known: CameraCalibration, ended: threading.Event) -> None:
    detector = ObjectDetector(known)
    while not ended.is_set():
        frame = camera.read()
        if frame is None:
            time.sleep(0.001)
        else:
            detector.detect(frame)


def _lateness(what: str, late: np.ndarray) -> dict[str, Any]:
    p50, p99, p999 = np.percentile(late, [50, 99, 99.9])
    over = 100.0 * float((late > 1.0).mean())
    return {
        "beside": what,
        "late p50 ms": p50,
        "p99 ms": p99,
        "p99.9 ms": p999,
        "over 1 ms %": over,
    }


def main() -> None:
    """Measure and print."""
    options = arguments("Accuracy of tag poses from a rendered camera.")
    bench = Bench(int(time.time()) if not options.quick else 0)
    hand_eye = calibration(bench)
    found = hand_eye.residuals
    off = hand_eye.camera_pose[:3, 3] - bench.camera.pose[:3, 3]
    print(
        f"calibration from {found.poses} poses: {found.pixel:.3f} px, {1e3 * found.position:.2f} "
        f"mm, each by the others {1e3 * found.left_out:.2f} mm; the camera's place is off by "
        f"{1e3 * np.linalg.norm(off):.2f} mm"
    )
    print(table([in_motion(bench, None), in_motion(bench, hand_eye)]))
    print(table(list(beside(bench, 2000 if options.quick else 10000))))
    report("tag_pose", list(at_rest(bench, 20 if options.quick else 250, hand_eye)), options)


if __name__ == "__main__":
    main()
