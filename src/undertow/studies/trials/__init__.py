"""Trials: controllers on realistic rigs, many seeds, in tables and figures; and ``ut.compare``.

:mod:`.experiments` names the experiments of ``undertow trials``; most are in
:mod:`.balance`, :mod:`.robustness`, :mod:`.estimation`, :mod:`.library` and :mod:`.upright`. One
controller on one rig is a :mod:`.trial`, the controllers are :mod:`.steering`'s, tables and figures
:mod:`.report`'s.
"""
