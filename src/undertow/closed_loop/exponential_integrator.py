"""The second phase of a rollout: large steps, once the law is inside its boundary layer.

There ṡ = −(k/ε) s holds exactly, however far the state is from the target, so that what the
linear model A leaves over, r(x) = ẋ − A x, is not stiff: it is of third order and slow.  An
exponential Runge-Kutta method of second order (ETD2RK; Cox and Matthews, J. Comput. Phys. 176,
2002) takes A exactly and r by

    a = e^{Ah} x + F(h) r(x),   x₊ = a + G(h) (r(a) − r(x)),
    F(h) = ∫₀ʰ e^{As} ds,       G(h) = ∫₀ʰ e^{A(h−s)} s/h ds.

Each lane has a step of its own, a power of two of the unit: it keeps the last term small in the
norm of V = xᵀPx, and cannot leap over the terminal set.  With AᵀP + PA = −Q the cost is
V(x) − V(x₊) + ∫ (Φ + V̇) dt, whose integrand is of fourth order: three points do.
Once r has died out the steps are as long as the terminal set is far.

*Bounds of states.*  With r as at x throughout, ẋ(s) = e^{As} ẋ(0) within a step, and a state x_i
that is bounded moves by no more than

    Σ_j F̄_ij |ẋ_j|,   F̄_ij ≥ |F_ij(s)| for all 0 ≤ s ≤ h;

where r grows to r(a) the motion differs by less than F̄ |r(a) − r(x)|, and twice that is added.  A
step is taken only if the margin that is then left is still larger than a spare part of the bound:
no large step decides whether it is kept, and of the smallest margin what is less than the spare
part is that of small steps.  A lane that no step is short enough for goes back to small ones.
"""

from __future__ import annotations

from collections.abc import Sequence

from undertow.closed_loop.linear_blocks import STEP_SIZES, UNIT
from undertow.closed_loop.trajectory import Event
from undertow.closed_loop.work_array import ENTERED, LANES, WorkArray, code, entrance, entry, total

#: Codes of a lane that waits for its large steps, and of one that cannot be done in this way.
HANDED_OVER, GIVEN_BACK = -1.0, -2.0

#: Column of the results that has the smallest margin of the first path constraint.
LOWEST = 6

#: Steps that a lane may take.
MOST = 4000

#: Largest correction in one step, as a part of the tolerance.
CORRECTION = 0.2


def _level(r: WorkArray, x: Sequence[str]) -> list[str]:
    """V = xᵀPx and p = P x."""
    size = len(x)
    return [
        *(
            f"p_{j} = " + total(f"{e} * {x[k]}" for k, e in enumerate(r.value[j]))
            for j in range(size)
        ),
        "level = " + total(f"p_{j} * {x[j]}" for j in range(size)),
    ]


def fetch(r: WorkArray) -> str:
    """Fetch the matrices P and A of all lanes."""
    size = len(r.x)
    return f"""\
for lane in range({LANES}):
    i = lane
    for j in range({size}):
        for k in range({size}):
            {entry(r.value)} = value[b + i, j, k]
    for j in range({size // 2}):
        for k in range({size}):
            {entry(r.linear)} = linear[b + i, j, k]
"""


def begin(r: WorkArray) -> list[str]:
    """Lanes that handed over begin with the smallest step; their costs include V."""
    size = len(r.x)
    columns = {r.cost: "0", r.end: "1", r.code: "2", r.radius: "3", r.steps: "-1"}
    return [
        *(f"{row} = out[b + i, {column}]" for row, column in columns.items()),
        *(f"x_{j} = out[b + i, out.shape[1] - {1 + size - j}]" for j in range(size)),
        *(f"{row} = x_{j}" for j, row in enumerate(r.x)),
        *(f"{row} = x_{j}" for j, row in enumerate(r.stage_x)),
        *(f"{row} = out[b + i, {LOWEST + k}]" for k, row in enumerate(r.low)),
        *_level(r, [f"x_{j}" for j in range(size)]),
        f"cost, begins = {r.cost}, {r.code} == {HANDED_OVER}",
        f"{r.active} = 1.0 if begins else 0.0",
        f"{r.begun} = 1.0 if begins else 0.0",
        f"{r.cost} = cost + counted * level if begins else cost",
        f"{r.span} = {UNIT}",
        f"{r.power} = 0.0",
        f"{r.ago} = 0.0",
        f"{r.last} = 0.0",
        f"{r.changed} = {r.active}",
    ]


def choose_step(r: WorkArray) -> str:
    """Fetch what a step of another length needs, for the lanes that change theirs.

    Not a loop of vectors: which lanes change, and to which power, is different for each.
    """
    size = len(r.x)
    half = size // 2
    bounds = ""
    if r.boxes:
        bounds = f"""\
        for j in range({len(r.boxes)}):
            for k in range({size}):
                {entry(r.reach)} = reach[block, power, (j * {size} + k) * {LANES} + i]
"""
    return f"""\
for lane in range({LANES}):
    i = lane
    if {r.changed} > 0.0:
        power = int({r.power})
        for j in range({size}):
            for k in range({size}):
                {entry(r.flow)} = powers[block, power, (j * {size} + k) * {LANES} + i]
            for k in range({half}):
                at = (j * {size} + {half} + k) * {LANES} + i
                {entry(r.force)} = forced[block, power, 0, at]
                {entry(r.rise)} = forced[block, power, 1, at]
{bounds}"""


def _bend(r: WorkArray) -> str:
    """Φ + V̇, or Φ alone where the cost has no quadratic part, from p = P x and the rates."""
    slope = total(f"p_{j} * {row}" for j, row in enumerate(r.slope))
    return f"{r.cost_slope} + 2.0 * counted * ({slope})"


def _rest(r: WorkArray, j: int, x: str) -> str:
    """The part of the j-th acceleration at a state x_0, x_1, … that A leaves over."""
    n = len(r.linear)
    return (
        f"{r.slope[n + j]} - (" + total(f"{e} * {x}_{k}" for k, e in enumerate(r.linear[j])) + ")"
    )


def _clear(r: WorkArray) -> list[str]:
    """Whether all bounds are out of this step's reach: ``clear``; of one four times: ``wide``."""
    half = range(len(r.linear))
    lines = [f"rate_{j} = abs(x_{j + len(half)})" for j in half]
    lines += [
        f"rate_{j + len(half)} = abs({row}) + 2.0 * abs(y_{j})" for j, row in enumerate(r.pull)
    ]
    for k, (_, spare) in enumerate(r.boxes):
        moved = total(f"{e} * rate_{j}" for j, e in enumerate(r.reach[k]))
        lines += [f"moved_{k} = {moved}", f"left_{k} = {r.room[k]} - {spare!r}"]
    boxes = range(len(r.boxes))
    return [
        *lines,
        "clear = " + " & ".join(f"(moved_{k} < left_{k})" for k in boxes),
        "wide = " + " & ".join(f"(4.0 * moved_{k} < left_{k})" for k in boxes),
    ]


def first_half(r: WorkArray, limits: Sequence[str]) -> list[str]:
    """From the rates at x to the state a; ``limits`` are the names of the inputs' limits."""
    size, half = len(r.x), range(len(r.linear))
    return [
        *(f"x_{j} = {row}" for j, row in enumerate(r.x)),
        *_level(r, [f"x_{j}" for j in range(size)]),
        *(f"q_{j} = {_rest(r, j, 'x')}" for j in half),
        *(f"{row} = q_{j}" for j, row in enumerate(r.rest)),
        f"{r.bend} = {_bend(r)}",
        *(f"{row} = {margin}" for row, margin in zip(r.room, r.path, strict=bool(r.boxes))),
        *(
            f"{row} = {rate}"
            for row, rate in zip(r.pull, r.slope[size // 2 :], strict=bool(r.boxes))
        ),
        f"{r.speed} = math.sqrt(" + total(f"{row} * {row}" for row in r.slope) + ")",
        "free = "
        + " & ".join(f"(abs({u}) < {limit})" for u, limit in zip(r.u, limits, strict=True)),
        f"{r.free} = 1.0 if free else 0.0",
        *(
            f"{r.stage_x[j]} = "
            + total(f"{e} * x_{k}" for k, e in enumerate(r.flow[j]))
            + " + "
            + total(f"{e} * q_{k}" for k, e in enumerate(r.force[j]))
            for j in range(size)
        ),
    ]


def second_half(r: WorkArray) -> list[str]:
    """From the rates at a to the end of the step, where it is taken; and the next step."""
    size, half = len(r.x), range(len(r.linear))
    bounds, clear, wide = (_clear(r), " & clear", " & wide") if r.boxes else ([], "", "")
    boxes = list(zip(r.room, r.low, strict=True))
    return [
        *(f"x_{j} = {row}" for j, row in enumerate(r.x)),
        *(f"a_{j} = {row}" for j, row in enumerate(r.stage_x)),
        *(f"y_{j} = {_rest(r, j, 'a')} - {r.rest[j]}" for j in half),
        *_level(r, [f"a_{j}" for j in range(size)]),
        f"bend, late = {r.bend}, {_bend(r)}",
        "high = level",
        *(
            f"c_{j} = " + total(f"{e} * y_{k}" for k, e in enumerate(r.rise[j]))
            for j in range(size)
        ),
        *_level(r, [f"c_{j}" for j in range(size)]),
        *bounds,
        f"small = ({CORRECTION} * tail) * ({CORRECTION} * tail) * high",
        *(f"a_{j} = a_{j} + c_{j}" for j in range(size)),
        "outer = math.sqrt(" + total(f"a_{j} * a_{j}" for j in range(size)) + ")",
        f"span, size, going = {r.span}, {r.power}, {r.active} > 0.0",
        # The trapezoidal rule, less h³/12 times the second derivative over this step and the last.
        f"last, ago, speed, free = {r.last}, {r.ago}, {r.speed}, {r.free} > 0.0",
        "turn = (late - bend) / span - ((bend - last) / ago if ago > 0.0 else 0.0)",
        "turn = 2.0 * turn / (span + ago) if ago > 0.0 else 0.0",
        "mean = 0.5 * (bend + late) - span * span * turn / 12.0",
        f"sound = free & (outer < escape) & ((size > 0.0) | (level <= 16.0 * small){clear})",
        f"before = {r.radius}",
        *(f"m_{j} = a_{j} - x_{j}" for j in range(size)),
        *entrance([f"x_{j}" for j in range(size)], "before * before"),
        *ENTERED,
        "inside = (outer <= terminal) | passed",
        "part = part if inside else 1.0",
        *(f"room_{k}, low_{k} = {room}, {low}" for k, (room, low) in enumerate(boxes)),
        "far = before - terminal > span * speed",
        f"taken = going & sound & ((size <= 0.0) | ((level <= small) & far & (not inside){clear}))",
        *(f"x_{j} = x_{j} + part * m_{j} if taken else x_{j}" for j in range(size)),
        *(f"{row} = x_{j}" for j, row in enumerate(r.x)),
        *(f"{row} = x_{j}" for j, row in enumerate(r.stage_x)),
        f"cost = {r.cost} + part * span * mean if taken else {r.cost}",
        f"end = {r.end} + part * span if taken else {r.end}",
        "radius = (terminal if inside else outer) if taken else before",
        "further = outer - terminal > 4.0 * span * speed",
        f"up = taken & further & (64.0 * level <= small) & (size < {STEP_SIZES - 1}.0){wide}",
        "down = going & (not taken) & (size > 0.0)",
        f"{r.power} = size + (1.0 if up else (-1.0 if down else 0.0))",
        f"{r.span} = span * (2.0 if up else (0.5 if down else 1.0))",
        f"{r.changed} = 1.0 if up | down else 0.0",
        f"{r.last} = bend if taken else last",
        f"{r.ago} = span if taken else ago",
        f"{r.steps} = {r.steps} + (1.0 if going else 0.0)",
        *(
            f"{low} = room_{k} if taken & (room_{k} < low_{k}) else low_{k}"
            for k, (_, low) in enumerate(boxes)
        ),
        f"{r.cost} = cost",
        f"{r.end} = end",
        f"{r.radius} = radius",
        "there = taken & inside & (end <= until)",
        "over = taken & (inside | (end >= until))",
        f"code = {r.code}",
        f"code = {code(Event.REACHED)} if there else ({code(Event.HORIZON)} if over else code)",
        f"{r.code} = {GIVEN_BACK} if going & (not sound) else code",
        f"{r.active} = 1.0 if going & sound & (not over) else 0.0",
    ]


def finish(r: WorkArray) -> list[str]:
    """Take V out of the costs again; lanes that are not done cannot be done in this way."""
    size = len(r.x)
    columns = {r.end: "1", r.radius: "3", r.steps: "-1"}
    return [
        *(f"x_{j} = {row}" for j, row in enumerate(r.x)),
        *_level(r, [f"x_{j}" for j in range(size)]),
        f"cost, begun = {r.cost}, {r.begun} > 0.0",
        "out[b + i, 0] = cost - counted * level if begun else cost",
        f"out[b + i, 2] = {GIVEN_BACK} if {r.active} > 0.0 else {r.code}",
        *(f"out[b + i, {column}] = {row}" for row, column in columns.items()),
        *(f"out[b + i, {LOWEST + k}] = {row}" for k, row in enumerate(r.low)),
        *(f"out[b + i, out.shape[1] - {1 + size - j}] = x_{j}" for j in range(size)),
    ]
