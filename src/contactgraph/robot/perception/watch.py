"""One round after another of looking at a camera's newest frame and telling what it shows."""

from collections.abc import Callable
from dataclasses import replace

from contactgraph.robot.perception.calibration import CameraCalibration
from contactgraph.robot.perception.camera import Camera
from contactgraph.robot.perception.shared_tracks import SharedTracks, TrackCounts
from contactgraph.robot.perception.sight import Sight
from contactgraph.robot.perception.tracker import ObjectTracker


class Watch:
    """Camera to tags to poses to tracks; ``clock`` tells the time that frames are stamped with."""

    def __init__(
        self,
        camera: Camera,
        calibration: CameraCalibration,
        tracks: SharedTracks,
        clock: Callable[[], float],
    ) -> None:
        self._camera, self._tracks, self._clock = camera, tracks, clock
        self._sight = Sight(calibration)
        self._trackers = {name: ObjectTracker() for name in calibration.objects}
        self._counts = {name: TrackCounts(0, 0, 0) for name in calibration.objects}

    def look(self) -> bool:
        """Takes the newest frame into account; False where there is none."""
        frame = self._camera.read()
        if frame is None:
            return False
        seen = self._sight.see(frame)
        for index, (name, tracker) in enumerate(self._trackers.items()):
            count = self._counts[name]
            lost = refused = 0
            if name not in seen:
                lost = 1
            elif not tracker.measure(seen[name].position, seen[name].covariance, frame.time):
                refused = 1
            self._counts[name] = replace(
                count,
                frames=count.frames + 1,
                lost=count.lost + lost,
                refused=count.refused + refused,
            )
            self._tracks.write(index, tracker.state, self._counts[name])
        self._tracks.add_frame(self._clock() - frame.time)
        return True
