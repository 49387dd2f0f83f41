"""Campaigns: many shards of work, a pure function of definition and number, and their store.

A :class:`Definition` is data; it means a :class:`Study`, whose grid is cut into shards.  A
:class:`Campaign` computes them on any executor and keeps them in zarr; :func:`dataset` reads them.
"""

from undertow.studies.campaign.definition import Definition
from undertow.studies.campaign.run import Campaign, CampaignResult, compute, executor_for
from undertow.studies.campaign.store import Store, dataset, digest
from undertow.studies.campaign.study import Study

__all__ = [
    "Campaign",
    "CampaignResult",
    "Definition",
    "Store",
    "Study",
    "compute",
    "dataset",
    "digest",
    "executor_for",
]
