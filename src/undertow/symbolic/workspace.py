"""Named arrays in one block of memory, handed to compiled code as a single argument.

Calling a compiled function costs more for each array that it takes (a tenth of a microsecond)
than most of the fast loop's arithmetic.  What a function remembers between calls is therefore
laid out once, in Python and in the generated source from the same list.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Decorator of generated functions that take about a microsecond, see
#: :data:`undertow.symbolic.compiler.brief`.  Every operation is rounded by itself (see
#: :data:`undertow.symbolic.function.COMPILED`).
BRIEF = "@brief(forceinline=True)"

#: Name of an array to its dimensions, Python expressions: ``{"P": "size, size"}``.
Layout = Mapping[str, str]


class Workspace:
    """One block of numbers, and named views of its parts.

    The layout has names and dimensions, written in ``sizes``; ``block`` is all of it,
    one-dimensional.

    Examples
    --------
    >>> memory = Workspace({"x": "n", "P": "n, n"}, n=2)
    >>> memory["P"][1, 0] = 7.0
    >>> memory.block.tolist()
    [0.0, 0.0, 0.0, 0.0, 7.0, 0.0]
    """

    def __init__(self, layout: Layout, **sizes: int) -> None:
        shapes = {
            name: tuple(eval(part, {"__builtins__": {}}, dict(sizes)) for part in parts.split(","))
            for name, parts in layout.items()
        }
        self.block: NDArray[np.float64] = np.zeros(
            sum(int(np.prod(shape)) for shape in shapes.values())
        )
        self._views: dict[str, Any] = {}
        at = 0
        for name, shape in shapes.items():
            count = int(np.prod(shape))
            self._views[name] = self.block[at : at + count].reshape(shape)
            at += count

    def __getitem__(self, name: str) -> Any:
        """Return the view of that name."""
        return self._views[name]


def unpacked(layout: Layout, *names: str) -> str:
    """Return the lines that give a compiled function the views of a block, all or by name.

    Where a view ends is added up as they go, once each: a compiler works on every sum that it sees.
    """
    wanted, lines = set(names or layout), ["    _end = 0"]
    for name, parts in layout.items():
        count = " * ".join(f"({part.strip()})" for part in parts.split(","))
        if name in wanted:
            shape = f".reshape(({parts}))" if "," in parts else ""
            lines.append(f"    {name} = block[_end : _end + {count}]{shape}")
            wanted.remove(name)
        if not wanted:
            break
        lines.append(f"    _end += {count}")
    return "\n".join(lines) + "\n"
