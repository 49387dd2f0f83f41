"""Straight-line loops in which each name is assigned once.

In C++ every assignment then declares a constant.  Here each makes a name of its own, and a choice
is a call of :func:`~.primitives.select`.  The values stay the same.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from itertools import count
from typing import TypeGuard, cast


def single_assignment(source: str) -> str:
    """Rewrite the innermost loops of a module: those whose bodies are assignments and no more.

    Names that are also read elsewhere in a function keep their names there.
    """
    tree = ast.parse(source)
    numbers = count()
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        loops = [node for node in ast.walk(function) if is_straight(node)]
        inside = {id(part) for loop in loops for line in loop.body for part in ast.walk(line)}
        elsewhere = {
            node.id
            for node in ast.walk(function)
            if isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Load)
            and id(node) not in inside
        }
        for loop in loops:
            _Loop(numbers, elsewhere).rewrite(loop)
    return ast.unparse(ast.fix_missing_locations(tree)) + "\n"


def is_straight(node: ast.AST) -> TypeGuard[ast.For]:
    """Whether a node is an innermost loop of assignments and no more."""
    return isinstance(node, ast.For) and all(
        isinstance(line, ast.Assign | ast.AugAssign) for line in node.body
    )


class _Loop(ast.NodeTransformer):
    """Rewrites one loop; ``names`` are the present ones of what it assigns."""

    def __init__(self, numbers: Iterator[int], kept: set[str]) -> None:
        self.numbers, self.kept, self.names = numbers, kept, dict[str, str]()

    def rewrite(self, loop: ast.For) -> None:
        """Give the loop's counter and its lines names of their own."""
        assert isinstance(loop.target, ast.Name)
        loop.target.id = self._own(loop.target.id)
        loop.body = [self.visit(line) for line in loop.body]

    def _own(self, name: str) -> str:
        self.names[name] = f"{name}__{next(self.numbers)}"
        return self.names[name]

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        node.value = self.visit(node.value)  # which reads what its names were before
        node.targets = [self.visit(target) for target in node.targets]
        return node

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AugAssign:
        node.value = self.visit(node.value)
        if not isinstance(node.target, ast.Name):  # a name is that of a sum over the loop
            node.target = self.visit(node.target)
        return node

    def visit_Name(self, node: ast.Name) -> ast.Name:
        if isinstance(node.ctx, ast.Store) and node.id not in self.kept:
            return ast.Name(self._own(node.id), node.ctx)
        return ast.Name(self.names.get(node.id, node.id), node.ctx)

    def visit_IfExp(self, node: ast.IfExp) -> ast.Call:
        parts = [self.visit(part) for part in (node.test, node.body, node.orelse)]
        return ast.Call(ast.Name("select", ast.Load()), parts, [])

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.expr:
        first, *rest = (cast(ast.expr, self.visit(value)) for value in node.values)
        operator = ast.BitAnd() if isinstance(node.op, ast.And) else ast.BitOr()
        for value in rest:
            first = ast.BinOp(first, operator, value)
        return first
