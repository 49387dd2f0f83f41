"""The studies behind the command line: one file or folder for each kind.

``paper`` repeats the paper's experiment, :mod:`.survey` takes every mechanism to its target,
``trials`` compares controllers on realistic rigs, ``campaign`` computes maps and statistics in
parallel, ``certification`` proves, ``rigs`` reports runs and bring-ups, ``fault_injection`` injects
faults, ``live`` feeds the live page. :mod:`.motion`, :mod:`.gallery`, :mod:`.model_files` and
:mod:`.doctor` stand behind the commands ``simulate`` and ``optimise``, ``mechanisms``, ``models``
and ``doctor``. Many tasks run as an :class:`~undertow.studies.experiment.Experiment`, which keeps
results in a :mod:`.ledger`.
"""
