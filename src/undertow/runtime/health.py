"""What a run watches about itself: shares of what fails, and the rig's clock against the host's."""

from __future__ import annotations

from undertow.runtime.settings import Settings

__all__ = ["RigClock", "Share"]

#: Time over which missed periods, and the rates of clocks, are looked at, s.
SECOND = 1.0


class Share:
    """The part of the last periods that failed, each weighing less the longer ago it was.

    Parameters
    ----------
    window
        Time constant of the weights, s: what failed one window ago weighs e⁻¹.
    period
        Of the fast loop, s.

    Attributes
    ----------
    value
        From 0 to 1; 0 at first, so that it takes some time until a share is found high.

    Examples
    --------
    >>> share = Share(0.1, 0.001)
    >>> for k in range(1000):
    ...     share.add(k % 4 == 0)
    >>> round(share.value, 2)
    0.25
    """

    def __init__(self, window: float, period: float) -> None:
        self._keep = max(0.0, 1.0 - period / window)
        self.value = 0.0

    def add(self, failed: int, periods: int = 1) -> None:
        """Count some periods, and how many of them failed."""
        keep = self._keep**periods
        self.value = keep * self.value + (1.0 - keep) * failed / periods


class RigClock:
    """Compares the time that a rig tells with the host's, and with the number of steps.

    The clock of hardware keeps to the host's, that of a simulated rig to the steps that it was
    taken through: both agree but where steps are missed, and a rig's clock may lie between them.
    A reading that runs back or jumps by more than a stall is left out: the sensors' watch judges
    it.  One that stands still, of a sensor slower than the loop or of a rig that took no output,
    may have let that time pass or not.

    Parameters
    ----------
    settings
        Largest drift in a second, s, and longest stall, s.
    period
        Of the fast loop, s.
    """

    def __init__(self, settings: Settings, period: float) -> None:
        self._drift, self._stall, self._period = settings.drift, settings.stall, period
        self._last: tuple[float, float, int] | None = None
        self._rig = self._host = self._steps = self._still = 0.0

    def check(self, stamp: float, now: float, step: int) -> str:
        """Return what is wrong with the rig's clock; empty where nothing is.

        Parameters
        ----------
        stamp
            Time of a reading on the rig's clock, s.
        now, step
            Time on the host's clock, s, and number of the step in which it was read.
        """
        last, self._last = self._last, (stamp, now, step)
        if last is None or not 0.0 <= stamp - last[0] <= self._stall:
            return ""
        host, steps = now - last[1], self._period * (step - last[2])
        moved, passed = stamp - last[0], max(host, steps)
        if not moved:
            host = steps = 0.0
        keep = max(0.0, 1.0 - passed / SECOND)
        self._still = keep * self._still + (0.0 if moved else passed)
        self._rig = keep * self._rig + moved
        self._host = keep * self._host + host
        self._steps = keep * self._steps + steps
        low, high = min(self._host, self._steps), max(self._host, self._steps) + self._still
        if low - self._drift <= self._rig <= high + self._drift:
            return ""
        off = abs(self._rig - (high if self._rig > high else low))
        rate = moved / passed
        return (
            f"the rig's clock went {1e3 * off:.0f} ms off the host's within a second, "
            f"it runs {rate:.2g} times as fast"
        )
