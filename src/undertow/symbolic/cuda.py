"""A generated loop as CUDA C++: one closed loop a thread, in the steps of the processor's kernel.

What is translated is the kernel's own text, after
:func:`undertow.symbolic.single_assignment.single_assignment`, so that there is one kernel and not
two: a loop over the lanes of a block becomes the block's one lane, and a row of the work array one
number, which the compiler keeps in a register.  Only what such kernels are written in is known;
anything else is refused by name.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

from undertow.base import ModelError
from undertow.symbolic.single_assignment import is_straight, single_assignment

Kind = Literal["bool", "long long", "double"]

#: Kinds by how much they hold.
KINDS: tuple[Kind, ...] = "bool", "long long", "double"

#: What every translated module begins with.  The host's compiler takes the same text.
PRELUDE = """\
#ifdef __CUDACC_RTC__
#define UNDERTOW_DEVICE static __device__
#else
#include <cmath>
#define UNDERTOW_DEVICE static inline
#endif
#define INFINITE (1.0 / 0.0)

template <class T> UNDERTOW_DEVICE T larger(T a, T b) { return b > a ? b : a; }
template <class T> UNDERTOW_DEVICE T smaller(T a, T b) { return b < a ? b : a; }
"""

#: One thread for each motion; without a GPU, one after the other.
LAUNCH = """
#ifdef __CUDACC_RTC__
extern "C" __global__ void {name}_all(long long count, {parameters})
{{
    const long long lane = (long long)blockIdx.x * blockDim.x + threadIdx.x;
    if (lane < count)
        {name}(lane, lane + 1, {arguments});
}}
#else
extern "C" void {name}_all(long long count, {parameters})
{{
    for (long long lane = 0; lane < count; ++lane)
        {name}(lane, lane + 1, {arguments});
}}
#endif
"""

_CALLS = {
    "math.sqrt": "sqrt",
    "math.pow": "pow",
    "math.sin": "sin",
    "math.cos": "cos",
    "math.tan": "tan",
    "math.tanh": "tanh",
    "math.exp": "exp",
    "math.log": "log",
    "np.floor": "floor",
    "abs": "fabs",
}
_OPERATORS: dict[type[ast.AST], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "/", ast.Mod: "%",
    ast.BitAnd: "&&", ast.BitOr: "||", ast.And: "&&", ast.Or: "||",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.USub: "-", ast.UAdd: "+", ast.Not: "!",
}  # fmt: skip


class Translation:
    """One function of a generated module, in C++.

    ``source``: the module's text. ``name``: the function.  Its first two parameters are the lanes
    from which and to which it goes; the others are numbers and arrays. ``kinds``: of its
    parameters, by name: ``"long long"``, ``"double"``, or for an array of float64 its number of
    axes, as text; ``"switch"`` is an array of int64. ``block``: lanes of a block of the work array
    ``W``. ``text``: the module in C++, with an entry ``<name>_all(count, …)`` for the lanes 0 to
    count − 1. ``shapes``: lengths that follow the parameters, as (array, axis): those that an index
    needs.
    """

    def __init__(self, source: str, name: str, kinds: Mapping[str, str], block: int) -> None:
        self.kinds, self.block = dict(kinds), block
        (function,) = (
            node
            for node in ast.walk(ast.parse(single_assignment(source)))
            if isinstance(node, ast.FunctionDef) and node.name == name
        )
        self.shapes: list[tuple[str, int]] = []
        self.rows = 0
        self.types: dict[str, Kind] = {}
        self._find_types(function)
        body = "\n".join(self._statements(function.body, 1))
        names = [argument.arg for argument in function.args.args][2:]
        lengths = [f"{array}_{axis}" for array, axis in self.shapes]
        parameters = ", ".join(
            [*(self._declared(n) for n in names), *(f"long long {n}" for n in lengths)]
        )
        declared = "\n".join(f"    {kind} {n} = 0;" for n, kind in self.types.items())
        self.text = (
            f"{PRELUDE}\nUNDERTOW_DEVICE void {name}(long long from_lane, long long to_lane, "
            f"{parameters})\n{{\n    double W[{self.rows}];\n{declared}\n{body}\n}}\n"
            + LAUNCH.format(
                name=name,
                parameters=parameters,
                arguments=", ".join([*map(_word, names), *lengths]),
            )
        )

    # -- names ---------------------------------------------------------------------------

    def _declared(self, name: str) -> str:
        kind = self.kinds[name]
        if kind in KINDS:
            return f"{kind} {_word(name)}"
        element = "long long" if name == "switch" else "double"
        return f"{element} *{_word(name)}"

    def _find_types(self, function: ast.FunctionDef) -> None:
        """Find the names that live as long as the function, with their kinds."""
        inside = {
            id(part) for loop in ast.walk(function) if is_straight(loop) for part in ast.walk(loop)
        }
        names = [node for node in ast.walk(function) if isinstance(node, ast.Name)]
        outside = {node.id for node in names if id(node) not in inside}
        for _ in range(3):  # what a name holds may depend on names assigned later
            for target, value in _assignments(function):
                if isinstance(target, ast.Name) and target.id in outside and not _dropped(target):
                    known = self.types.get(target.id, "bool")
                    self.types[target.id] = max(known, self._kind(value), key=KINDS.index)

    def _kind(self, node: ast.expr) -> Kind:
        match node:
            case ast.Constant(value=bool()) | ast.Compare() | ast.BoolOp():
                return "bool"
            case ast.UnaryOp(op=ast.Not()) | ast.BinOp(op=ast.BitAnd() | ast.BitOr()):
                return "bool"
            case ast.Constant(value=int()):
                return "long long"
            case ast.Name(id=name):
                given = self.kinds.get(name, self.types.get(name, "long long"))
                return given if given in KINDS else "double"
            case ast.BinOp(op=ast.Div()):
                return "double"
            case ast.BinOp(left=a, right=b) | ast.IfExp(body=a, orelse=b):
                return max(self._kind(a), self._kind(b), "long long", key=KINDS.index)
            case ast.Call(func=ast.Name(id="max" | "min"), args=values):
                return max(map(self._kind, values), key=KINDS.index)
            case ast.Call(func=ast.Name(id="select"), args=[_, a, b]):
                return max(self._kind(a), self._kind(b), key=KINDS.index)
            case ast.Call(func=ast.Name(id="round" | "int")):
                return "long long"
            case ast.Subscript(value=ast.Attribute(attr="shape")):
                return "long long"
            case ast.Subscript(value=ast.Name(id="switch")):
                return "long long"
            case ast.UnaryOp(operand=operand):
                return self._kind(operand)
        return "double"

    # -- statements ----------------------------------------------------------------------

    def _statements(self, body: Iterable[ast.stmt], depth: int) -> list[str]:
        pad, lines = "    " * depth, list[str]()
        for node in body:
            match node:
                case ast.Assign(targets=[target]) if _dropped(target):
                    pass
                case ast.Assign() | ast.AugAssign():
                    lines += [pad + line for line in self._assign(node)]
                case ast.For() if is_straight(node):
                    assert isinstance(node.target, ast.Name)
                    inner = self._statements(node.body, depth + 1)
                    name = node.target.id
                    lines += [f"{pad}{{", f"{pad}    const long long {name} = 0;"]
                    lines += [*inner, f"{pad}}}"]
                case ast.For(target=ast.Name(id=name), iter=ast.Call(args=values)):
                    first, last, step = _range([self._text(value) for value in values])
                    lines.append(
                        f"{pad}for (long long {name} = {first}; {name} < {last}; {name} += {step})"
                        " {"
                    )
                    lines += [*self._statements(node.body, depth + 1), f"{pad}}}"]
                case ast.If(orelse=[]):
                    lines.append(f"{pad}if ({self._text(node.test)}) {{")
                    lines += [*self._statements(node.body, depth + 1), f"{pad}}}"]
                case ast.Break():
                    lines.append(f"{pad}break;")
                case _:
                    raise _unknown(node)
        return lines

    def _assign(self, node: ast.Assign | ast.AugAssign) -> list[str]:
        if isinstance(node, ast.AugAssign):
            sign = _OPERATORS[type(node.op)]
            return [f"{self._text(node.target)} {sign}= {self._text(node.value)};"]
        lines = []
        for target, value in _pairs(node.targets[0], node.value):
            own = isinstance(target, ast.Name) and target.id not in self.types
            declaration = "const auto " if own else ""
            lines.append(f"{declaration}{self._text(target)} = {self._text(value)};")
        return lines

    # -- expressions ---------------------------------------------------------------------

    def _text(self, node: ast.expr) -> str:
        match node:
            case ast.Constant(value=bool(value)):
                return "true" if value else "false"
            case ast.Constant(value=int(value)):
                return f"{value}LL"
            case ast.Constant(value=float(value)):
                return repr(value)
            case ast.Name(id=name):
                return _word(name)
            case ast.Attribute(value=ast.Name(id="math"), attr="inf"):
                return "INFINITE"
            case ast.UnaryOp(op=op, operand=operand):
                return f"{_OPERATORS[type(op)]}({self._text(operand)})"
            case ast.BinOp(op=ast.Mod(), left=a, right=b) if self._kind(node) == "double":
                x, y = self._text(a), self._text(b)
                return f"({x} - {y} * floor({x} / {y}))"
            case ast.BinOp(left=a, op=op, right=b) if type(op) in _OPERATORS:
                return f"({self._text(a)} {_OPERATORS[type(op)]} {self._text(b)})"
            case ast.BoolOp(op=op, values=values):
                return "(" + f" {_OPERATORS[type(op)]} ".join(map(self._text, values)) + ")"
            case ast.Compare(left=a, ops=[op], comparators=[b]):
                return f"({self._text(a)} {_OPERATORS[type(op)]} {self._text(b)})"
            case ast.IfExp(test=test, body=a, orelse=b):
                return self._choice(test, a, b)
            case ast.Call(func=ast.Name(id="select"), args=[test, a, b]):
                return self._choice(test, a, b)
            case ast.Call(func=ast.Name(id="round"), args=[value]):
                return f"(long long)rint({self._text(value)})"
            case ast.Call(func=ast.Name(id="max" | "min" as which), args=[first, *rest]):
                kind = max(map(self._kind, node.args), key=KINDS.index)
                name = {"max": "larger", "min": "smaller"}[which]
                text = self._text(first)
                for value in rest:
                    text = f"{name}<{kind}>({text}, {self._text(value)})"
                return text
            case ast.Call(func=function, args=values) if ast.unparse(function) in _CALLS:
                arguments = ", ".join(map(self._text, values))
                return f"{_CALLS[ast.unparse(function)]}({arguments})"
            case ast.Subscript(value=ast.Name(id="W"), slice=ast.BinOp(left=ast.Constant() as at)):
                assert isinstance(at.value, int)
                row = at.value // self.block
                self.rows = max(self.rows, row + 1)
                return f"W[{row}]"
            case ast.Subscript(value=ast.Name(id=name), slice=ast.Tuple(elts=indices)):
                return f"{_word(name)}[{self._place(name, indices)}]"
            case ast.Subscript(value=ast.Name(id=name), slice=index):
                return f"{_word(name)}[{self._text(index)}]"
            case ast.Subscript(
                value=ast.Attribute(value=ast.Name(id=name), attr="shape"),
                slice=ast.Constant(value=int(axis)),
            ):
                return self._length(name, axis)
        raise _unknown(node)

    def _choice(self, test: ast.expr, a: ast.expr, b: ast.expr) -> str:
        return f"({self._text(test)} ? {self._text(a)} : {self._text(b)})"

    def _place(self, name: str, indices: Sequence[ast.expr]) -> str:
        text = self._text(indices[0])
        for axis, index in enumerate(indices[1:], 1):
            text = f"({text}) * {self._length(name, axis)} + {self._text(index)}"
        return text

    def _length(self, name: str, axis: int) -> str:
        if (name, axis) not in self.shapes:
            self.shapes.append((name, axis))
        return f"{name}_{axis}"


def _word(name: str) -> str:
    """Return a name that C++ has no other use for."""
    return f"{name}_" if name == "switch" else name


def _dropped(target: ast.expr) -> bool:
    """Whether an assignment only makes the work array."""
    return isinstance(target, ast.Name) and target.id == "W"


def _pairs(target: ast.expr, value: ast.expr) -> list[tuple[ast.expr, ast.expr]]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        return list(zip(target.elts, value.elts, strict=True))
    return [(target, value)]


def _assignments(function: ast.FunctionDef) -> Iterable[tuple[ast.expr, ast.expr]]:
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            yield from _pairs(node.targets[0], node.value)
        elif isinstance(node, ast.AugAssign):
            yield node.target, node.value


def _range(ends: list[str]) -> tuple[str, str, str]:
    first, last = ("0LL", *ends) if len(ends) == 1 else ends[:2]
    return first, last, ends[2] if len(ends) > 2 else "1LL"


def _unknown(node: ast.AST) -> ModelError:
    return ModelError(
        "generated kernel in CUDA C++",
        value=ast.unparse(node)[:80],
        limit="assignments, loops over ranges, choices and elementary functions",
        remedy="Roll out on the processor",
    )
