"""Display: formulas, stick figures, phase planes, films, and the live page.

:mod:`.derivation` prints a mechanism's formulas; :mod:`.sketches` has the figures of the library's
mechanisms, :mod:`.tree_sketch` makes those of others; :mod:`.plot` and :mod:`.animation` draw.
The page and its server are in :mod:`.live`. Time histories are drawn by
:mod:`undertow.closed_loop.figures`.
"""
