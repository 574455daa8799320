"""One round after another of looking at a camera's newest frame and telling what it shows."""

from collections.abc import Callable
from dataclasses import replace

from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import Camera
from contactgraph_franka.perception.shared_sightings import Measured, SharedSightings, SightCounts
from contactgraph_franka.perception.sight import Sight


class Watch:
    """Camera to tags to poses to places; ``clock`` tells the time that frames are stamped with."""

    def __init__(
        self,
        camera: Camera,
        calibration: CameraCalibration,
        shared: SharedSightings,
        clock: Callable[[], float],
    ) -> None:
        self._camera, self._shared, self._clock = camera, shared, clock
        self._sight = Sight(calibration)
        self._newest: dict[str, Measured | None] = dict.fromkeys(calibration.objects)
        self._counts = {name: SightCounts(0, 0) for name in calibration.objects}

    def look(self) -> bool:
        """Takes the newest frame into account; False where there is none."""
        frame = self._camera.read()
        if frame is None:
            return False
        seen = self._sight.see(frame)
        for index, name in enumerate(self._newest):
            found = seen.get(name)
            if found is not None:
                self._newest[name] = Measured(found.position, found.covariance, frame.time)
            count = self._counts[name]
            self._counts[name] = replace(
                count, frames=count.frames + 1, lost=count.lost + (found is None)
            )
            self._shared.write(index, self._newest[name], self._counts[name])
        self._shared.add_frame(self._clock() - frame.time)
        return True
