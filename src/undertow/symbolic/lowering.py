"""Plain arithmetic as LLVM's instructions, past numba's front end: its types, and itself.

What is plain: assignments, ``if``, ``while`` and ``for`` over a range, with real numbers, whole
numbers and truth values, elements and rows of arrays, and calls of compiled functions.  Each
operation becomes the instructions that numba chooses for it, so that the results are the same bits.
"""

from __future__ import annotations

import ast
import builtins
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from typing import Any

from llvmlite import ir
from numba.core import cgutils as numba_cgutils
from numba.core import errors as numba_errors
from numba.core import typing as numba_typing
from numba.np import arrayobj as numba_arrays

from undertow.symbolic.machine import numba
from undertow.symbolic.primitives import select

#: Modules without types.
cgutils: Any = numba_cgutils
arrays: Any = numba_arrays
errors: Any = numba_errors
typing: Any = numba_typing
llvm: Any = ir
types: Any = numba.types

#: A value of LLVM's behind numba's type of it.
Typed = tuple[Any, Any]

REAL, WHOLE, TRUTH = types.float64, types.int64, types.boolean


class UnsuitedError(errors.NumbaError):  # type: ignore[misc]
    """What numba's own front end has to compile."""


class Part:
    """A piece of a function that is compiled as one instruction of numba's.

    ``body``: its lines. ``inputs``: names that they read. ``results``: names that are read behind
    them. ``scope``: the function's global names.
    """

    def __init__(
        self,
        body: Sequence[ast.stmt],
        inputs: Sequence[str],
        results: Sequence[str],
        scope: Mapping[str, Any],
    ) -> None:
        self.body, self.inputs, self.results, self.scope = body, inputs, results, scope
        self.returns = any(isinstance(node, ast.Return) for line in body for node in ast.walk(line))
        stored = {name.id for line in body for name in _in_order(line) if _is_stored(name)}
        self.local = _local(body, (*inputs, *results)) | (set(inputs) - stored)

    def __call__(self) -> None:
        """Let numba take it for a function."""

    def enter(
        self, typing_context: Any, target_context: Any, attributes: Sequence[str] = ()
    ) -> None:
        """Make it known to numba; ``attributes``: of the functions that it is part of."""
        part, kinds = self, dict[Any, Any]()

        class Template(typing.templates.AbstractTemplate):  # type: ignore[misc]
            key = part

            def generic(self, args: Any, kws: Any) -> Any:
                del kws
                if args not in kinds:
                    kinds[args] = _Types(part, self.context, args)
                return typing.signature(kinds[args].result, *args)

        def write(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            for attribute in attributes:
                builder.function.attributes.add(attribute)
            return _Instructions(part, context, builder, kinds[signature.args]).write(values)

        write.signature = (types.VarArg(types.Any),)  # type: ignore[attr-defined]
        typing_context.insert_global(part, types.Function(Template))
        target_context.insert_func_defn([(write, part, (types.VarArg(types.Any),))])

    def leave(self, target_context: Any) -> None:
        """Let numba forget it: what calls it is compiled."""
        target_context.remove_user_function(self)


def _local(body: Sequence[ast.stmt], shared: Sequence[str]) -> set[str]:
    """Return the names that each list of lines that holds them begins by assigning.

    None of these lists lies in another one. ``shared``: names that have a value before or behind
    the lines.
    """
    stores: dict[str, dict[int, bool]] = {name: {0: False} for name in shared}
    around: dict[int, set[int]] = {0: set()}

    def see(node: ast.AST, where: int) -> None:
        for name in _in_order(node):
            stores.setdefault(name.id, {}).setdefault(where, _is_stored(name))

    def walk(lines: Sequence[ast.stmt], outside: set[int]) -> None:
        here = id(lines)
        around[here], inside = outside, outside | {here}
        for line in lines:
            match line:
                case ast.For(target, each, inner):
                    see(each, here)
                    see(target, id(inner))
                    walk(inner, inside)
                case ast.While(test, inner):
                    see(test, 0)
                    walk(inner, inside)
                case ast.If(test, yes, no):
                    see(test, here)
                    walk(yes, inside)
                    walk(no, inside)
                case _:
                    see(line, here)

    walk(body, set())
    return {
        name
        for name, lists in stores.items()
        if all(first and not around[where] & lists.keys() for where, first in lists.items())
    }


def _is_stored(name: ast.Name) -> bool:
    return isinstance(name.ctx, ast.Store)


def _in_order(node: ast.AST) -> Iterator[ast.Name]:
    """Yield the names of a line as it meets them: what is assigned comes last."""
    match node:
        case ast.Name():
            yield node
        case ast.Assign(targets, value):
            yield from _in_order(value)
            for target in targets:
                yield from _in_order(target)
        case ast.AugAssign(ast.Name(name), _, value):
            yield from _in_order(value)
            yield ast.Name(name, ast.Load())
            yield ast.Name(name, ast.Store())
        case _:
            for part in ast.iter_child_nodes(node):
                yield from _in_order(part)


class _Walk:
    """What types and instructions of a part have in common: how names and calls are found."""

    part: Part

    def function(self, node: ast.expr) -> Any:
        """Return the function that is called."""
        match node:
            case ast.Attribute(ast.Name(module), name):
                return getattr(self.part.scope[module], name)
            case ast.Name(name):
                found = self.part.scope.get(name, getattr(builtins, name, None))
                if found is not None:
                    return found
        raise UnsuitedError(ast.unparse(node))

    def constant(self, node: ast.expr) -> Any:
        """Return what a global name stands for."""
        match node:
            case ast.Attribute(ast.Name(module), name) if module in self.part.scope:
                return getattr(self.part.scope[module], name)
            case ast.Name(name) if name in self.part.scope:
                return self.part.scope[name]
        raise UnsuitedError(ast.unparse(node))

    def assign_all(
        self, targets: Sequence[ast.expr], value: ast.expr, found: Callable[[ast.expr], Any]
    ) -> None:
        """Assign what is found of a value: of a tuple's parts each to its own name."""
        match value:
            case ast.Tuple(parts) if any(isinstance(target, ast.Tuple) for target in targets):
                each = [found(part) for part in parts]
                for target in targets:
                    assert isinstance(target, ast.Tuple)
                    for name, one in zip(target.elts, each, strict=True):
                        self.assign(name, one)
            case _:
                whole = found(value)
                for target in targets:
                    self.assign(target, whole)

    def assign(self, target: ast.expr, found: Any) -> None:
        """Assign what was found of a value."""
        raise NotImplementedError


def parts_of(node: ast.Subscript) -> list[ast.expr]:
    """Return the indices of an element."""
    return node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]


# -- types ---------------------------------------------------------------------------------------


class _Types(_Walk):
    """The types of all names of a part, for given ones of its inputs.

    ``names``: of those that keep a place in memory; ``result``: of what it returns.
    """

    def __init__(self, part: Part, context: Any, given: Sequence[Any]) -> None:
        self.part, self.context, self.given = part, context, given
        self.either: dict[int, Any] = {}  # by the expression: what either branch of it is
        self.names: dict[str, Any] = {}
        self.returned: Any = None
        kinds = dict(zip(part.inputs, map(types.unliteral, given), strict=True))
        before: Any = None
        while before != (self.names, self.returned):
            before = dict(self.names), self.returned
            self.known: dict[str, Any] = {}
            for name, kind in kinds.items():
                self._keep(name, kind)
            self.lines(part.body)
        if part.returns:
            self.result = self.returned
        else:
            found = [self.names[name] for name in part.results]
            if any(isinstance(kind, types.Array) for kind in found):
                raise UnsuitedError("an array that is read later")
            several = types.BaseTuple.from_types(found)
            self.result = types.none if not found else found[0] if len(found) == 1 else several

    def _keep(self, name: str, kind: Any) -> None:
        if name in self.part.local:
            self.known[name] = kind
            return
        known = self.names.setdefault(name, kind)
        both = self.context.unify_types(known, kind)
        if both is None or (isinstance(kind, types.Array) and both != kind):
            raise UnsuitedError(f"{name} as {known} and {kind}")
        self.names[name] = both

    def lines(self, lines: Sequence[ast.stmt]) -> None:
        """Find the types of what lines assign."""
        for line in lines:
            match line:
                case ast.Assign(targets, part):
                    self.assign_all(targets, part, self.kind)
                case ast.AugAssign(target, how, part):
                    reading = ast.copy_location(_loaded(target), target)
                    self.assign(target, self.kind(ast.BinOp(reading, how, part)))
                case ast.For(target, ast.Call(_, limits), inner):
                    for limit in limits:
                        self.whole(limit)
                    self.assign(target, WHOLE)
                    self.lines(inner)
                case ast.While(test, inner):
                    self.kind(test)
                    self.lines(inner)
                case ast.If(test, yes, no):
                    self.kind(test)
                    self.lines(yes)
                    self.lines(no)
                case ast.Return(part):
                    kind = types.none if part is None else self.kind(part)
                    before = kind if self.returned is None else self.returned
                    self.returned = self.context.unify_types(before, kind)
                    if self.returned is None or isinstance(self.returned, types.Array):
                        raise UnsuitedError(f"returns {before} or {kind}")
                case ast.Expr(ast.Call() as called):
                    self.kind(called)

    def whole(self, node: ast.expr) -> None:
        """Refuse what is no whole number."""
        if not isinstance(self.kind(node), types.Integer):
            raise UnsuitedError(ast.unparse(node))

    def assign(self, target: ast.expr, found: Any) -> None:
        """Note the type of what is assigned."""
        match target:
            case ast.Name(name):
                self._keep(name, found)
            case ast.Subscript(value):
                array = self.kind(value)
                fixed = isinstance(array, types.BaseTuple) or not getattr(array, "mutable", True)
                if fixed or isinstance(self.element(array, target), types.Array):
                    raise UnsuitedError(ast.unparse(target))
            case ast.Tuple(parts) if isinstance(found, types.BaseTuple):
                for part, each in zip(parts, found, strict=True):
                    self.assign(part, each)
            case _:
                raise UnsuitedError(ast.unparse(target))

    def kind(self, node: ast.expr) -> Any:
        """Return the type of an expression."""
        match node:
            case ast.Name(name) if name in self.known:
                return self.known[name]
            case ast.Name(name) if name in self.names:
                return self.names[name]
            case ast.Constant(bool()):
                return TRUTH
            case ast.Constant(int()):
                return WHOLE
            case ast.Constant(float()):
                return REAL
            case ast.Attribute(array, "shape"):
                return types.UniTuple(WHOLE, self.array(array).ndim)
            case ast.Attribute(array, "size"):
                return WHOLE if self.array(array) else None
            case ast.Name() | ast.Attribute():
                return types.unliteral(self.context.resolve_value_type(self.constant(node)))
            case ast.Tuple(parts):
                return types.BaseTuple.from_types([self.kind(part) for part in parts])
            case ast.Subscript(value):
                return self.element(self.kind(value), node)
            case ast.UnaryOp(ast.Not(), part):
                return TRUTH if self.kind(part) else None
            case ast.UnaryOp(how, part):
                return self.called(_OPERATORS[type(how)], [self.kind(part)])
            case ast.BinOp(left, how, right):
                kinds = [self.kind(left), self.kind(right)]
                common = self.context.unify_types(*kinds)
                if common is not None and type(how) in _instructions(common):
                    return common
                return self.called(_OPERATORS[type(how)], kinds)
            case ast.Compare(left, _, right):
                kinds = [self.kind(part) for part in (left, *right)]
                if not all(isinstance(kind, types.Number | types.Boolean) for kind in kinds):
                    raise UnsuitedError(ast.unparse(node))
                return TRUTH
            case ast.BoolOp(_, parts):
                return self.common(node, [*map(self.kind, parts)], TRUTH)
            case ast.IfExp(test, yes, no):
                self.kind(test)
                self.either[id(node)] = self.common(node, [self.kind(yes), self.kind(no)])
                return self.either[id(node)]
            case ast.Call(function, parts):
                found, kinds = self.function(function), [self.kind(part) for part in parts]
                if found is select:
                    return self.common(node, kinds[1:])
                if found in (max, min):
                    return self.common(node, kinds)
                if found is len and isinstance(kinds[0], types.Array | types.BaseTuple):
                    return WHOLE
                if found in _CASTS and isinstance(kinds[0], types.Number | types.Boolean):
                    return _CASTS[found]
                return self.called(found, kinds)
        raise UnsuitedError(ast.unparse(node))

    def common(self, node: ast.expr, kinds: Sequence[Any], wanted: Any = None) -> Any:
        """Return the type that values have in common: numbers, or what is wanted."""
        kind = reduce(self.context.unify_types, kinds)
        right = kind == wanted if wanted else isinstance(kind, types.Number | types.Boolean)
        if not right:
            raise UnsuitedError(ast.unparse(node))
        return kind

    def array(self, node: ast.expr) -> Any:
        """Return the type of an array."""
        kind = self.kind(node)
        if not isinstance(kind, types.Array):
            raise UnsuitedError(ast.unparse(node))
        return kind

    def element(self, kind: Any, node: ast.Subscript) -> Any:
        """Return the type of an element, or of a row."""
        parts = parts_of(node)
        if isinstance(kind, types.BaseTuple):
            match parts:
                case [ast.Constant(int() as place)]:
                    return kind[place]
            if isinstance(kind, types.UniTuple):
                self.whole(parts[0])
                return kind.dtype
        for part in parts:
            self.whole(part)
        if isinstance(kind, types.CPointer) and len(parts) == 1:
            return kind.dtype
        if isinstance(kind, types.Array) and len(parts) <= kind.ndim:
            return _row(kind, len(parts)) if len(parts) < kind.ndim else kind.dtype
        raise UnsuitedError(ast.unparse(node))

    def called(self, function: Any, kinds: Sequence[Any]) -> Any:
        """Return the type of what a function returns."""
        return _resolved(self.context, function, kinds)[1].return_type


def _row(kind: Any, count: int) -> Any:
    """Return the type of what so many indices leave of an array."""
    return kind.copy(ndim=kind.ndim - count, layout="C" if kind.layout == "C" else "A")


def _loaded(target: ast.expr) -> ast.expr:
    match target:
        case ast.Name(name):
            return ast.Name(name, ast.Load())
        case ast.Subscript(value, place):
            return ast.Subscript(value, place, ast.Load())
    raise UnsuitedError(ast.unparse(target))


def _resolved(context: Any, function: Any, kinds: Sequence[Any]) -> tuple[Any, Any]:
    """Return numba's type of a function, and its signature for arguments of some types."""
    known = context.resolve_value_type(function)
    signature = known.get_call_type(context, tuple(kinds), {})
    if signature is None:
        raise UnsuitedError(f"{function} of {kinds}")
    scalar = types.Number, types.Boolean, types.NoneType, types.BaseTuple
    if not isinstance(signature.return_type, scalar):
        raise UnsuitedError(f"{function} returns {signature.return_type}")
    return known, signature


# -- instructions --------------------------------------------------------------------------------


class _Instructions(_Walk):
    """Writes the instructions of a part; ``kinds`` are the types of its names."""

    def __init__(self, part: Part, context: Any, builder: Any, kinds: _Types) -> None:
        self.part, self.context, self.builder, self.kinds = part, context, builder, kinds
        self.names: dict[str, Typed] = {}
        self.places: dict[str, Any] = {}
        self.loops: list[tuple[Any, Any]] = []  # where `continue` and `break` go
        self.end: Any = None

    def write(self, values: Sequence[Any]) -> Any:
        """Write the lines; return the value of their result."""
        for name, kind in self.kinds.names.items():
            shape = self.context.get_value_type(kind)
            self.places[name] = cgutils.alloca_once(self.builder, shape, zfill=True)
        kinds = map(types.unliteral, self.kinds.given)
        for name, kind, value in zip(self.part.inputs, kinds, values, strict=True):
            self.assign(ast.Name(name), (kind, value))
        if self.part.returns:
            self.end = self.builder.append_basic_block()
            shape = self.context.get_value_type(self.kinds.result)
            self.answer = cgutils.alloca_once(self.builder, shape, zfill=True)
        self.lines(self.part.body)
        if self.part.returns:
            self._go(self.end)
            self.builder.position_at_end(self.end)
            return self.builder.load(self.answer)
        found = [self.builder.load(self.places[name]) for name in self.part.results]
        if not found:
            return self.context.get_dummy_value()
        if len(found) == 1:
            return found[0]
        return self.context.make_tuple(self.builder, self.kinds.result, found)

    # lines

    def lines(self, lines: Sequence[ast.stmt]) -> None:
        """Write lines, up to one that leaves."""
        for line in lines:
            if self.builder.block.is_terminated:
                return
            self.line(line)

    def line(self, line: ast.stmt) -> None:
        """Write one line."""
        match line:
            case ast.Assign(targets, part):
                self.assign_all(targets, part, self.value)
            case ast.AugAssign(ast.Name(name) as target, how, part):
                before = self.value(ast.Name(name, ast.Load()))
                self.assign(target, self.binary(how, before, self.value(part)))
            case ast.AugAssign(ast.Subscript() as target, how, part):
                kind, place, array = self.place(target)
                before = kind, self._read(place, array)
                self._store(kind, place, array, self.binary(how, before, self.value(part)))
            case ast.For(ast.Name(name), ast.Call(_, limits), inner):
                self._for(name, limits, inner)
            case ast.While(test, inner):
                again, turn, end = self._blocks(3)
                self._begin(again)
                self.builder.cbranch(self.truth(test), turn, end)
                self._turn(turn, inner, again, end)
                self.builder.position_at_end(end)
            case ast.If(test, yes, no):
                yes_block, no_block, end = self._blocks(3)
                self.builder.cbranch(self.truth(test), yes_block, no_block)
                for block, inner in ((yes_block, yes), (no_block, no)):
                    self.builder.position_at_end(block)
                    self.lines(inner)
                    self._go(end)
                self.builder.position_at_end(end)
            case ast.Continue():
                self.builder.branch(self.loops[-1][0])
            case ast.Break():
                self.builder.branch(self.loops[-1][1])
            case ast.Return(part):
                if part is not None:
                    value = self.cast(self.kinds.result, self.value(part))
                    self.builder.store(value, self.answer)
                self.builder.branch(self.end)
            case ast.Expr(ast.Call() as called):
                self.value(called)

    def _go(self, block: Any) -> None:
        if not self.builder.block.is_terminated:
            self.builder.branch(block)

    def _begin(self, block: Any) -> None:
        """Go on in a new block."""
        self.builder.branch(block)
        self.builder.position_at_end(block)

    def _blocks(self, count: int) -> list[Any]:
        return [self.builder.append_basic_block() for _ in range(count)]

    def _turn(self, block: Any, lines: Sequence[ast.stmt], again: Any, end: Any) -> None:
        """Write a turn of a loop; ``again`` and ``end``: where it and the loop end."""
        self.builder.position_at_end(block)
        self.loops.append((again, end))
        self.lines(lines)
        self.loops.pop()
        self._go(again)

    def _for(self, name: str, limits: Sequence[ast.expr], inner: Sequence[ast.stmt]) -> None:
        values = [self.cast(WHOLE, self.value(limit)) for limit in limits]
        step = llvm.Constant(llvm.IntType(64), 1) if len(values) < 3 else values[2]
        first = llvm.Constant(llvm.IntType(64), 0) if len(values) < 2 else values[0]
        stop = values[0] if len(values) < 2 else values[1]
        counter = cgutils.alloca_once_value(self.builder, first)
        head, turn, next_, end = self._blocks(4)
        self._begin(head)
        at = self.builder.load(counter)
        sign = ">" if step.constant < 0 else "<"
        self.builder.cbranch(self.builder.icmp_signed(sign, at, stop), turn, end)
        self.builder.position_at_end(turn)
        self.assign(ast.Name(name), (WHOLE, at))
        self._turn(turn, inner, next_, end)
        self.builder.position_at_end(next_)
        self.builder.store(self.builder.add(at, step, flags=("nsw",)), counter)
        self.builder.branch(head)
        self.builder.position_at_end(end)

    def assign(self, target: ast.expr, found: Typed) -> None:
        """Write a value to where it belongs."""
        match target:
            case ast.Name(name) if name in self.places:
                self.builder.store(self.cast(self.kinds.names[name], found), self.places[name])
            case ast.Name(name):
                self.names[name] = found
            case ast.Subscript():
                self._store(*self.place(target), found)
            case ast.Tuple(parts):
                each = cgutils.unpack_tuple(self.builder, found[1])
                for part, kind, one in zip(parts, found[0], each, strict=True):
                    self.assign(part, (kind, one))

    def _store(self, kind: Any, place: Any, array: Any, value: Typed) -> None:
        if array is None:
            self.builder.store(self.cast(kind, value), place)
        else:
            arrays.store_item(self.context, self.builder, array, self.cast(kind, value), place)

    def _read(self, place: Any, array: Any) -> Any:
        if array is None:
            return self.builder.load(place)
        return arrays.load_item(self.context, self.builder, array, place)

    def place(self, node: ast.Subscript) -> tuple[Any, Any, Any]:
        """Return the type and the address of an element, and the array's type if it is of one."""
        kind, base = self.value(node.value)
        where = [self.cast(WHOLE, self.value(part)) for part in parts_of(node)]
        if isinstance(kind, types.CPointer):
            return kind.dtype, self.builder.gep(base, where), None
        array = self.context.make_array(kind)(self.context, self.builder, base)
        return kind.dtype, self._address(kind, array, where), kind

    def _address(self, kind: Any, array: Any, where: Sequence[Any]) -> Any:
        zero = llvm.Constant(llvm.IntType(64), 0)
        return cgutils.get_item_pointer2(
            self.context,
            self.builder,
            array.data,
            cgutils.unpack_tuple(self.builder, array.shape, kind.ndim),
            cgutils.unpack_tuple(self.builder, array.strides, kind.ndim),
            kind.layout,
            [*where, *[zero] * (kind.ndim - len(where))],
            wraparound=True,
        )

    # values

    def value(self, node: ast.expr) -> Typed:
        """Write an expression."""
        match node:
            case ast.Name(name) if name in self.names:
                return self.names[name]
            case ast.Name(name) if name in self.places:
                return self.kinds.names[name], self.builder.load(self.places[name])
            case ast.Constant(number):
                return self._constant(number)
            case ast.Attribute(array, "shape"):
                kind, made = self._array(array)
                return types.UniTuple(WHOLE, kind.ndim), made.shape
            case ast.Attribute(array, "size"):
                return WHOLE, self._array(array)[1].nitems
            case ast.Name() | ast.Attribute():
                return self._constant(self.constant(node))
            case ast.Tuple(parts):
                values = [self.value(part) for part in parts]
                kind = types.BaseTuple.from_types([value[0] for value in values])
                return kind, self.context.make_tuple(self.builder, kind, [v[1] for v in values])
            case ast.Subscript(value):
                return self._element(node, value)
            case ast.UnaryOp(how, part):
                return self._unary(how, part)
            case ast.BinOp(left, how, right):
                return self.binary(how, self.value(left), self.value(right))
            case ast.Compare(left, signs, rest):
                values = [self.value(part) for part in (left, *rest)]
                found = [
                    self.compare(sign, values[k], values[k + 1])[1] for k, sign in enumerate(signs)
                ]
                return TRUTH, reduce(self.builder.and_, found)
            case ast.BoolOp(how, [first, *rest]):
                return self._both(how, first, rest)
            case ast.IfExp(test, yes, no):
                return self._either(self.kinds.either[id(node)], test, yes, no)
            case ast.Call(function, parts):
                return self.called(self.function(function), [self.value(part) for part in parts])
        raise UnsuitedError(ast.unparse(node))

    def _constant(self, value: Any) -> Typed:
        kind = types.unliteral(self.context.typing_context.resolve_value_type(value))
        return kind, self.context.get_constant_generic(self.builder, kind, value)

    def _array(self, node: ast.expr) -> tuple[Any, Any]:
        kind, value = self.value(node)
        return kind, self.context.make_array(kind)(self.context, self.builder, value)

    def _element(self, node: ast.Subscript, value: ast.expr) -> Typed:
        kind, base = self.value(value)
        parts = parts_of(node)
        if isinstance(kind, types.BaseTuple):
            match parts:
                case [ast.Constant(int() as place)]:
                    return kind[place], self.builder.extract_value(base, place % len(kind))
            return self.called(operator.getitem, [(kind, base), self.value(parts[0])])
        if isinstance(kind, types.CPointer) or len(parts) == kind.ndim:
            found, place, array = self.place(node)
            return found, self._read(place, array)
        row = _row(kind, len(parts))
        whole = self.context.make_array(kind)(self.context, self.builder, base)
        where = [self.cast(WHOLE, self.value(part)) for part in parts]
        made = self.context.make_array(row)(self.context, self.builder)
        arrays.populate_array(
            made,
            data=self._address(kind, whole, where),
            shape=cgutils.unpack_tuple(self.builder, whole.shape, kind.ndim)[len(parts) :],
            strides=cgutils.unpack_tuple(self.builder, whole.strides, kind.ndim)[len(parts) :],
            itemsize=whole.itemsize,
            meminfo=None,
        )
        return row, made._getvalue()

    def cast(self, kind: Any, value: Typed) -> Any:
        """Return a value as one of another type."""
        known, instruction = value
        if known == kind:
            return instruction
        return self.context.cast(self.builder, instruction, known, kind)

    def truth(self, node: ast.expr) -> Any:
        """Write a test."""
        return self.cast(TRUTH, self.value(node))

    def _alike(self, values: Sequence[Typed]) -> tuple[Any, list[Any]]:
        """Return the type that values have in common, if any, and them as such."""
        kinds = [kind for kind, _ in values]
        kind = reduce(self.context.typing_context.unify_types, kinds)
        return kind, [] if kind is None else [self.cast(kind, value) for value in values]

    def _unary(self, how: ast.unaryop, part: ast.expr) -> Typed:
        if isinstance(how, ast.Not):
            return TRUTH, self.builder.not_(self.truth(part))
        match how, part:
            case ast.USub(), ast.Constant(int() | float() as number):
                return self._constant(-number)
        kind, value = self.value(part)
        if isinstance(how, ast.USub) and kind == REAL:
            return REAL, self.builder.fsub(llvm.Constant(value.type, -0.0), value)
        return self.called(_OPERATORS[type(how)], [(kind, value)])

    def binary(self, how: ast.operator, *values: Typed) -> Typed:
        """Write an operation on two values."""
        kind = self.context.typing_context.unify_types(*(kind for kind, _ in values))
        names = _instructions(kind)
        if type(how) in names:
            left, right = (self.cast(kind, value) for value in values)
            return kind, getattr(self.builder, names[type(how)])(left, right)
        return self.called(_OPERATORS[type(how)], values)

    def compare(self, how: ast.cmpop, *values: Typed) -> Typed:
        """Write a comparison of two values."""
        kind, (left, right) = self._alike(values)
        sign = SIGNS[type(how)]
        if not isinstance(kind, types.Float):
            signed = isinstance(kind, types.Integer) and kind.signed
            compare = self.builder.icmp_signed if signed else self.builder.icmp_unsigned
        else:
            compare = self.builder.fcmp_unordered if sign == "!=" else self.builder.fcmp_ordered
        return TRUTH, compare(sign, left, right)

    def _is_risky(self, node: ast.expr) -> bool:
        """Whether to evaluate what is not asked for might do harm, or take long."""
        for part in ast.walk(node):
            match part:
                case ast.Subscript(ast.Name(name)) if name in self.names:
                    if not isinstance(self.names[name][0], types.CPointer):
                        return True  # an element may be outside
                case ast.Subscript():
                    return True
                case ast.Call(function) if hasattr(self.function(function), "py_func"):
                    return True
        return False

    def _both(self, how: ast.boolop, first: ast.expr, rest: Sequence[ast.expr]) -> Typed:
        """Write tests, of which a later one may be evaluated only where it decides."""
        known = self.truth(first)
        for part in rest:
            if not self._is_risky(part):
                write = self.builder.and_ if isinstance(how, ast.And) else self.builder.or_
                known = write(known, self.truth(part))
                continue
            place = cgutils.alloca_once(self.builder, llvm.IntType(1))
            self.builder.store(known, place)
            other = known if isinstance(how, ast.And) else self.builder.not_(known)
            with self.builder.if_then(other):
                self.builder.store(self.truth(part), place)
            known = self.builder.load(place)
        return TRUTH, known

    def _either(self, kind: Any, test: ast.expr, yes: ast.expr, no: ast.expr) -> Typed:
        if not (self._is_risky(yes) or self._is_risky(no)):
            return self.called(select, [self.value(part) for part in (test, yes, no)])
        place = cgutils.alloca_once(self.builder, self.context.get_value_type(kind))
        with self.builder.if_else(self.truth(test)) as (then, otherwise):
            with then:
                self.builder.store(self.cast(kind, self.value(yes)), place)
            with otherwise:
                self.builder.store(self.cast(kind, self.value(no)), place)
        return kind, self.builder.load(place)

    def called(self, function: Any, values: Sequence[Typed]) -> Typed:
        """Write a call."""
        if function is select:
            kind, (yes, no) = self._alike(values[1:])
            return kind, self.builder.select(self.cast(TRUTH, values[0]), yes, no)
        if function in (max, min):
            sign = ast.Gt() if function is max else ast.Lt()
            return reduce(lambda best, value: self._better(sign, value, best), values)
        if function is len and isinstance(values[0][0], types.BaseTuple):
            return self._constant(len(values[0][0]))
        if function is len:
            kind, array = values[0]
            made = self.context.make_array(kind)(self.context, self.builder, array)
            return WHOLE, cgutils.unpack_tuple(self.builder, made.shape, kind.ndim)[0]
        if function in _CASTS and isinstance(values[0][0], types.Number | types.Boolean):
            return _CASTS[function], self.cast(_CASTS[function], values[0])
        kinds = [kind for kind, _ in values]
        known, signature = _resolved(self.context.typing_context, function, kinds)
        given = [self.cast(kind, value) for kind, value in zip(signature.args, values, strict=True)]
        made = self.context.get_function(known, signature)
        value = made(self.builder, given)
        self.context.add_linking_libs(getattr(made, "libs", ()))
        return signature.return_type, value

    def _better(self, sign: ast.cmpop, value: Typed, best: Typed) -> Typed:
        """Return a value if it compares so with the best one, else that: no number never does."""
        kind, (new, old) = self._alike([value, best])
        _, wins = self.compare(sign, (kind, new), (kind, old))
        return kind, self.builder.select(wins, new, old)


def _instructions(kind: Any) -> Mapping[type[ast.operator], str]:
    """Return the operations on a type that are one instruction."""
    return {REAL: _REALS, WHOLE: _WHOLES, TRUTH: _TRUTHS}.get(kind, {})


_REALS: dict[type[ast.operator], str] = {
    ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv",
}  # fmt: skip
_WHOLES: dict[type[ast.operator], str] = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul"}
_TRUTHS: dict[type[ast.operator], str] = {ast.BitAnd: "and_", ast.BitOr: "or_"}
SIGNS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
_OPERATORS: dict[type[ast.operator] | type[ast.unaryop], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: operator.truediv, ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod,
    ast.Pow: operator.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
    ast.BitAnd: operator.and_, ast.BitOr: operator.or_, ast.BitXor: operator.xor,
    ast.LShift: operator.lshift, ast.RShift: operator.rshift, ast.Invert: operator.invert,
}  # fmt: skip
_CASTS: dict[Any, Any] = {float: REAL, int: WHOLE, bool: TRUTH}
