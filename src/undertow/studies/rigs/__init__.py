"""Runs, bring-ups and exported controllers as tables and figures; and two studies of them.

:mod:`~undertow.studies.rigs.bring_up` counts how often the intervals of a bring-up hold the
truth, :mod:`~undertow.studies.rigs.export` upsets every bit of an exported controller's memory.
"""
