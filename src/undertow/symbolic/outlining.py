"""The plain lines of a function: which they are, what they read, and what is read of them later."""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import textwrap
from collections.abc import Iterable, Sequence
from types import FunctionType
from typing import Any

import numpy as np

from undertow.symbolic.lowering import SIGNS, Part
from undertow.symbolic.primitives import select


def outline(function: Any) -> tuple[Any, list[Part]]:
    """Return a function that calls parts where another one's lines are plain, and the parts."""
    if function.__closure__:
        return function, []
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(definition, ast.FunctionDef)
    definition.decorator_list, definition.returns = [], None
    outliner = _Outliner(definition, function.__globals__)
    outliner.outline()
    module = ast.fix_missing_locations(ast.Module([definition], []))
    scope = {**function.__globals__, **outliner.parts}
    exec(compile(module, function.__code__.co_filename, "exec"), scope)
    made: FunctionType = scope[definition.name]
    made.__qualname__, made.__module__ = function.__qualname__, function.__module__
    return made, list(outliner.parts.values())


class _Outliner:
    """Takes the plain lines out of a function."""

    #: Nodes that make a call of a part worth its price.
    WORTH = 12

    def __init__(self, function: ast.FunctionDef, scope: dict[str, Any]) -> None:
        self.function, self.scope = function, scope
        self.parts: dict[str, Part] = {}
        self.given = [each.arg for each in function.args.args]
        self.own = {*self.given, *_stored(function.body)}
        self.rows = set().union(*map(_rows, ast.walk(function))) & set().union(
            *map(_used_whole, ast.walk(function))
        )
        self.kept: set[str] = set()  # rows that parts do not assign

    def outline(self) -> None:
        """Outline the function: its whole body, or the runs of plain lines in it."""
        body = self.function.body
        if isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
            body = body[1:]
        if body and all(self.is_plain(line, whole=True) for line in body):
            part, call = self._part(body, set())
            self.function.body = [ast.Return(call) if part.returns else ast.Expr(call)]
        else:
            self.function.body = self._lines(body, set())

    def _lines(self, lines: Sequence[ast.stmt], after: set[str]) -> list[ast.stmt]:
        """Return lines with calls of parts; ``after``: names that are read behind them."""
        made: list[ast.stmt] = []
        run: list[ast.stmt] = []
        for k, line in enumerate([*lines, None]):
            if line is not None and self.is_plain(line):
                run.append(line)
                continue
            if run:
                # What the rest assigns may be read all the same: a turn of a loop may end before.
                later = _exposed(lines[k:], self.own) | after
                rows = _stored(run) & later & self.rows
                if rows:  # which numba has to keep
                    self.rows, self.kept = self.rows - rows, self.kept | rows
                    return self._lines(lines, after)
                made += self._run(run, later)
                run = []
            if line is not None:
                made.append(self._inside(line, _exposed(lines[k + 1 :], self.own) | after))
        return made

    def _inside(self, line: ast.stmt, after: set[str]) -> ast.stmt:
        """Outline what a line that is not plain holds."""
        match line:
            case ast.For() | ast.While():
                again = _exposed([line], self.own) | after
                line.body = self._lines(line.body, again)
                line.orelse = self._lines(line.orelse, after)
            case ast.If():
                line.body = self._lines(line.body, after)
                line.orelse = self._lines(line.orelse, after)
        return line

    def _run(self, run: list[ast.stmt], after: set[str]) -> list[ast.stmt]:
        """Return the call of a part, or the lines themselves where that would cost more."""
        if sum(1 for line in run for _ in ast.walk(line)) < self.WORTH:
            return run
        part, call = self._part(run, after)
        match part.results:
            case []:
                return [ast.Expr(call)]
            case [name]:
                return [ast.Assign([ast.Name(name, ast.Store())], call)]
        names = ast.Tuple([ast.Name(name, ast.Store()) for name in part.results], ast.Store())
        return [ast.Assign([names], call)]

    def _part(self, body: list[ast.stmt], after: set[str]) -> tuple[Part, ast.Call]:
        """Return a part and a call of it; ``after``: names that are read behind it."""
        results = sorted(_stored(body) & after)
        reads = _exposed(body, self.own) | (set(results) - _assigned(body))
        inputs = sorted(reads & {*self.given, *self._assigned_outside(body)})
        name, part = f"_part_{len(self.parts)}", Part(body, inputs, results, self.scope)
        self.parts[name] = part
        given: list[ast.expr] = [ast.Name(each, ast.Load()) for each in inputs]
        return part, ast.Call(ast.Name(name, ast.Load()), given, [])

    def _assigned_outside(self, run: list[ast.stmt]) -> set[str]:
        """Return the names that the function assigns in other lines than those of a run."""
        own = set(map(id, run))

        def found(lines: Sequence[ast.stmt]) -> set[str]:
            names: set[str] = set()
            for line in lines:
                if id(line) not in own:
                    inner = [getattr(line, part, []) for part in ("body", "orelse")]
                    names |= set().union(*map(found, inner)) if any(inner) else _stored([line])
                    names |= _stored([line.target]) if isinstance(line, ast.For) else set()
            return names

        return found(self.function.body)

    # what is plain

    def is_plain(self, line: ast.stmt, *, whole: bool = False, loop: bool = False) -> bool:
        """Whether a line is plain; ``whole``: with its function; ``loop``: in a loop of a part."""
        match line:
            case ast.Assign(targets, value):
                if _stored([line]) & self.kept:
                    return False
                parts = [t.elts for t in targets if isinstance(t, ast.Tuple)]
                match value:
                    case ast.Tuple(values):
                        same = all(len(each) == len(values) for each in parts)
                        plain = same and len(parts) == len(targets)
                    case ast.Call() | ast.Attribute():
                        plain = True
                    case _:
                        plain = not parts  # else numba looks how many there are
                return plain and self._are(value, *targets)
            case ast.AugAssign(target, how, value):
                return self._is(ast.BinOp(target, how, value))
            case ast.For(ast.Name(), ast.Call(ast.Name("range"), limits, []), inner, []):
                step = limits[2] if len(limits) > 2 else ast.Constant(1)
                fixed = isinstance(step, ast.Constant) or (
                    isinstance(step, ast.UnaryOp) and isinstance(step.operand, ast.Constant)
                )
                return (
                    fixed
                    and self._are(*limits)
                    and all(self.is_plain(each, whole=whole, loop=True) for each in inner)
                )
            case ast.While(test, inner, []):
                return self._is(test) and all(
                    self.is_plain(each, whole=whole, loop=True) for each in inner
                )
            case ast.If(test, yes, no):
                return self._is(test) and all(
                    self.is_plain(each, whole=whole, loop=loop) for each in (*yes, *no)
                )
            case ast.Break() | ast.Continue():
                return loop
            case ast.Pass():
                return True
            case ast.Return(value):
                return whole and (value is None or self._is(value))
            case ast.Expr(ast.Call() as called):
                return self._is(called)
        return False

    def _are(self, *nodes: ast.expr) -> bool:
        return all(self._is(node) for node in nodes)

    def _is(self, node: ast.expr) -> bool:
        match node:
            case ast.Name():
                return True
            case ast.Constant(value):
                return isinstance(value, bool | int | float)
            case ast.Attribute(ast.Name(module)) if module not in self.own:
                return inspect.ismodule(self.scope.get(module))
            case ast.Attribute(ast.Name(), "shape" | "size"):
                return True
            case ast.Tuple(parts):
                return self._are(*parts)
            case ast.Subscript(value, ast.Tuple(parts)):
                return self._are(value, *parts)
            case ast.Subscript(value, part):
                return self._are(value, part)
            case ast.UnaryOp(_, part):
                return self._is(part)
            case ast.BinOp(_, ast.Pow(), ast.Constant(int())) | ast.BinOp(_, ast.MatMult()):
                return False  # numba multiplies out
            case ast.BinOp(left, _, right):
                return self._are(left, right)
            case ast.BoolOp(_, parts):
                return self._are(*parts)
            case ast.Compare(left, signs, rest):
                return all(type(sign) in SIGNS for sign in signs) and self._are(left, *rest)
            case ast.IfExp(test, yes, no):
                return self._are(test, yes, no)
            case ast.Call(function, parts, []):
                return self._are(*parts) and self._is_function(function)
        return False

    def _is_function(self, node: ast.expr) -> bool:
        match node:
            case ast.Attribute(ast.Name(module), name) if module not in self.own:
                known = self.scope.get(module)
                return known is math or (known is np and name in _OF_NUMBERS)
            case ast.Name(name) if name not in self.own:
                found = self.scope.get(name, getattr(builtins, name, None))
                ours = hasattr(found, "py_func")
                return ours or found in (select, abs, max, min, len, int, float, bool)
        return False


#: Functions of NumPy that take numbers.
_OF_NUMBERS = {"floor", "ceil", "sqrt", "abs", "exp", "sin", "cos"}


def _rows(node: ast.AST) -> set[str]:
    """Return the names that a line makes elements, or rows, of arrays."""
    match node:
        case ast.Assign([ast.Tuple(targets)], ast.Tuple(values)):
            pairs = [*zip(targets, values, strict=False)]
        case ast.Assign(targets, value):
            pairs = [(target, value) for target in targets]
        case _:
            return set()
    return {
        target.id
        for target, value in pairs
        if isinstance(target, ast.Name) and isinstance(value, ast.Subscript)
    }


def _used_whole(node: ast.AST) -> set[str]:
    """Return the names that may be arrays: one takes elements of them, or gives them away."""
    match node:
        case ast.Subscript(ast.Name(name)):
            return {name}
        case ast.Call(_, given):
            return {each.id for each in given if isinstance(each, ast.Name)}
    return set()


def _names(node: ast.AST) -> tuple[set[str], set[str]]:
    """Return the names that a piece of a function reads, and those that it assigns."""
    known: tuple[set[str], set[str]] | None = getattr(node, "_names", None)
    if known is None:
        names = [part for part in ast.walk(node) if isinstance(part, ast.Name)]
        stores = {name.id for name in names if isinstance(name.ctx, ast.Store)}
        known = {name.id for name in names if isinstance(name.ctx, ast.Load)}, stores
        vars(node)["_names"] = known
    return known


def _stored(lines: Iterable[ast.AST]) -> set[str]:
    return set().union(*(_names(line)[1] for line in lines))


def _assigned(lines: Sequence[ast.stmt]) -> set[str]:
    """Return the names that lines assign whatever happens."""
    known: set[str] = set()
    _exposed(lines, set(), known)
    return known


#: Lines after which there is no next one.
_LEAVES = ast.Break, ast.Continue, ast.Return


def _exposed(lines: Sequence[ast.stmt], own: set[str], known: set[str] | None = None) -> set[str]:
    """Return which of a function's names lines may read before they assign them.

    ``known``: names that are assigned before, to which those are added that the lines assign.
    """
    known = set() if known is None else known
    found: set[str] = set()

    def read(*nodes: ast.AST | None) -> None:
        for node in nodes:
            if node is not None:
                found.update(_names(node)[0] & own - known)

    for line in lines:
        match line:
            case ast.For(target, each, body, otherwise):
                read(each)
                inside = known | _stored([target])
                found |= _exposed(body, own, inside)
                found |= _exposed(otherwise, own, set(known))
            case ast.While(test, body, otherwise):
                read(test)
                found |= _exposed(body, own, set(known))
                found |= _exposed(otherwise, own, set(known))
            case ast.If(test, yes, no):
                read(test)
                branches = []
                for inner in (yes, no):
                    branch = set(known)
                    found |= _exposed(inner, own, branch)
                    if not inner or not isinstance(inner[-1], _LEAVES):
                        branches.append(branch)
                known |= set.intersection(*branches) if branches else _stored([line])
            case ast.AugAssign(target, _, value):
                read(value, target)
                if isinstance(target, ast.Name):
                    found.update({target.id} & own - known)
                known |= _stored([line])
            case _:
                read(line)
                known |= _stored([line])
    return found
