"""The search for the best plan from a state: what it may choose, and how it looks for it.

Begin at :class:`Optimiser` (:mod:`.optimiser`): global the first time, warm-started afterwards.
:mod:`.task` is one search that can be asked at any moment, :mod:`.search` composes it of methods
(:mod:`.cma_es`, :mod:`.trust_region`, both ask/tell; :mod:`.arrival` for least time) in the
coordinates of :mod:`.search_space`. :mod:`.schedules` looks for several surfaces in turn, which
follow the earliest motion of :mod:`.open_loop`; :mod:`.switching` for single ones that switch where
it does. :mod:`.confidence` tells how likely the answer of a global search is the best one.
"""

from undertow.optimiser.cma_es import CMAES
from undertow.optimiser.optimiser import Optimiser, Planner
from undertow.optimiser.proposal import Budget, Proposal
from undertow.optimiser.search_space import DecisionVariables

__all__ = ["CMAES", "Budget", "DecisionVariables", "Optimiser", "Planner", "Proposal"]
