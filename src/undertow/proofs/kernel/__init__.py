"""The trusted kernel: decides the claims of a certificate from its file, and imports nothing else.

A claim is proved by what is in this folder, Python's standard library, NumPy's arrays and numba's
compiler; no other part of Undertow, no SymPy and no search is imported (a contract in
``pyproject.toml``).  What a file means, and the lemmas that the rules rest on, are in
``docs/certificate-format.md``.

``compiled``: outward-rounded intervals, the one interpreter of graphs (values, derivatives, Taylor
coefficients) and the Taylor step.  ``graph``: expressions, exact or lowered to code.  ``model``:
M, f, B and the law of a file, and the closed loop that is made of them.  ``reader``: the file.
``bound``: branch and bound.  ``region``: sets on the surface.  ``tube``: validated integration.
``loop``: the closed loop, continuous or held.  ``claims``: the rules.
"""
