"""The arm's clock in terms of the reader's."""


class ArmClock:
    """Tells when, on the reader's clock, what the arm stamped on its own was so.

    A state that is seen for the first time came between the last look and this one, and that is
    all that is known for sure: the offset between the clocks changes only as far as it must to lie
    between. So stamps have no jitter of the reader's, and follow an arm whose clock is slower or
    stands still for a while. The way of the packet, some 0.2 ms, is not known and not in it.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._looked = 0.0

    def unchanged(self, now: float) -> None:
        """A look at ``now`` s found nothing new."""
        self._looked = now

    def changed(self, arm_time: float, now: float) -> float:
        """s on the reader's clock, of a new state that is found at ``now`` s."""
        if self._offset is None:
            self._offset = now - arm_time
        else:
            earliest, latest = self._looked - arm_time, now - arm_time
            self._offset = min(max(self._offset, earliest), latest)
        self._looked = now
        return arm_time + self._offset
