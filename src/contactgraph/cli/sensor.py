"""The contact sensor that a user describes."""

from contactgraph.cli.options import check_range
from contactgraph.data import InvalidInputError
from contactgraph.evaluate import SensorFaults


def sensor_faults(false_alarms: float, misses: float, delay: int, seed: int) -> SensorFaults:
    """The sensor that the flags describe. Raises `InvalidInputError` for what no sensor can be."""
    for flag, rate in (("--false-alarms", false_alarms), ("--misses", misses)):
        if not 0.0 <= rate < 1.0:
            raise InvalidInputError(f"{flag} must be a share from 0 to below 1, found {rate}")
    check_range("--delay", delay, 0, 1000)
    return SensorFaults(false_alarms, misses, delay, seed)
