"""The search for a surface: decision variables, CMA-ES, trust region, task and result."""

from undertow.optimiser.cma_es import CMAES
from undertow.optimiser.optimiser import Optimiser, Planner
from undertow.optimiser.proposal import Budget, Proposal
from undertow.optimiser.search_space import DecisionVariables

__all__ = [
    "CMAES",
    "Budget",
    "DecisionVariables",
    "Optimiser",
    "Planner",
    "Proposal",
]
