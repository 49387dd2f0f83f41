"""Swing-up and catch: energy to the top, then the sliding-mode law, and back if thrown out.

``law`` is the energy law, ``catch`` the hand-over, ``search`` finds the law's gains.
"""

from undertow.cascade.swing_up.catch import CatchRegion, SwingUpAndCatch
from undertow.cascade.swing_up.law import Gains, SwingUp, hanging
from undertow.cascade.swing_up.search import designed

__all__ = ["CatchRegion", "Gains", "SwingUp", "SwingUpAndCatch", "designed", "hanging"]
