"""How likely the best of some local minima is the best of all; knows nothing of control.

Of N local searches from independent random starts, W ended in different minima.  Before them any
number K of minima is as likely as any other, and so is any division of the starts among them.
Then the minima that were seen are expected to be the part (N − W − 1)/(N − 1) of all, E[W/K]: the
posterior of K is that of [1]_, p(K) ∝ K! (K−1)!/((K−W)! (N+K−1)!), summed by Gauss's theorem.  As
good a minimum is as likely to be found early as late, so this is how likely the best of all was
among them.  Good minima tend to be wide ones, which are found sooner: it rather errs on the low
side.

References
----------
.. [1] Boender and Rinnooy Kan, "Bayesian stopping rules for multistart global optimization
   methods", Math. Program. 37 (1987) 59-80.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

#: Minima whose costs differ by less than this part count as one.
ALIKE = 0.01


def confidence(minima: Sequence[float]) -> float | None:
    """Return how likely the best of some minima is within 1 % of the best of all.

    ``minima``: where searches from independent random starts ended, one cost each; those that found
    nothing, ``inf``, are left out. Returns 0 where each ended elsewhere; ``None`` for fewer than
    two, which tell nothing.
    """
    ends = sorted(cost for cost in minima if math.isfinite(cost))
    if len(ends) < 2:
        return None
    kinds, last = 0, -math.inf
    for cost in ends:
        if not kinds or cost - last > ALIKE * abs(last):
            kinds, last = kinds + 1, cost
    return max(0.0, (len(ends) - kinds - 1) / (len(ends) - 1))
