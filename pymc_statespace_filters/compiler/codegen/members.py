"""Loops over the members of an ensemble, as one LLVM function.

What does not depend on the member is computed once, before the loop. A loop vectorises only if LLVM
knows that the rows it reads and writes do not overlap, and if it has no branch. So there are two
forms. A few results are written to their rows at once. Otherwise members are moved in blocks, whose
numbers are in rows of a buffer. A function with branches divides such a loop in two: one stage
computes its arguments for a block of members; the function maps these rows to another one; the next
stage goes on with that. What a stage needs of earlier ones is kept in rows too.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core import cgutils

from ..native.entry_point import F64_PTR, EntryPoint
from ..numerics.quantiles.binomial import binomial_block
from ..numerics.quantiles.gamma import gamma_block
from ..numerics.quantiles.poisson import poisson_block
from .arguments import MEMBER_ARGUMENTS
from .emitter import Emitter, depends_on
from .expressions import FLOAT, Expression, Value
from .function_types import MEMBER_INPUTS, Graph
from .machine_code import DOUBLE, INT, Module, ModuleEntryPoint, constant

BLOCK = 64

# Whose rows LLVM is told not to overlap, each with every other.
MAX_ROWS_WRITTEN = 32

_MAX_BUFFER = 8192  # numbers, on the stack

BLOCKS = {
    "poisson_quantile": poisson_block,
    "binomial_quantile": binomial_block,
    "gamma_quantile": gamma_block,
}
"""Functions with branches for a block of members: of rows of a buffer."""


def is_block(value: Value) -> bool:
    """Whether a value is the result of a function with branches."""
    return isinstance(value, Expression) and getattr(value.op, "machine_code", None) in BLOCKS


def sorted_by_number(values: Any) -> list[Expression]:
    """Expressions in order of creation, so that the code is canonical."""
    return sorted((v for v in values if isinstance(v, Expression)), key=lambda v: v.number)


def member_entry_point(
    name: str, graph: Graph, values: Sequence[Value], target: str, *, vector: bool
) -> ModuleEntryPoint:
    """``values`` of every member, written to the rows of ``target``."""
    module = Module()
    code = _Members(module, graph, values, target, vector=vector)
    sizes = {name: v.type.shape[0] for name, v in graph.inputs.items() if v.type.ndim}
    members = frozenset(f"{i}.{k}" for i in MEMBER_INPUTS for k in range(sizes.get(i, 0)))
    dependent = depends_on(values, members)
    common = [a for e in dependent for a in e.args if e.op is not None and a not in dependent]
    kept = sorted_by_number({*common, *(v for v in values if v not in dependent)})
    code.emitter.emit(kept)
    blocks = sorted_by_number(filter(is_block, dependent)) if vector else []
    if vector and (blocks or len(values) > MAX_ROWS_WRITTEN):
        _Stages(code, dependent, kept).emit()
    else:
        code.loop(values)
    code.emitter.builder.ret_void()
    return ModuleEntryPoint(module.finished(), MEMBER_ARGUMENTS, name)


class _Members:
    """The function under construction: its arguments, and the places of inputs and results."""

    def __init__(
        self, module: Module, graph: Graph, values: Sequence[Value], target: str, *, vector: bool
    ) -> None:
        self.module, self.values, self._target = module, values, target
        self.builder, self.arguments = module.main(MEMBER_ARGUMENTS)
        inputs = graph.inputs.get("u")
        self._n_inputs = 0 if inputs is None else inputs.type.shape[0]
        written = [f"{target}.{i}" for i in range(len(values))]
        few = len(values) <= MAX_ROWS_WRITTEN
        self._distinct = module.distinct([*written, "others"]) if few else {}
        self._rows: dict[tuple[str, int], ir.Value] = {}
        self.member: ir.Value | None = None
        self.emitter = Emitter(module, self.builder, self._read, vector=vector)

    def _read(self, name: str) -> ir.Value:
        vector, _, number = name.partition(".")
        i, given, build = int(number), self.arguments, self.builder
        if vector == "t":
            return given["t"]
        if vector in MEMBER_INPUTS:
            return self._marked(build.load(self._place(vector.replace("x", "X"), i)), vector, i)
        if vector == "u":
            first = build.mul(given["k"], constant(self._n_inputs))
            return build.load(build.gep(given["inputs"], [build.add(first, constant(i))]))
        source = {"theta": "c", "gains": "out"}.get(vector, "z")
        return build.load(build.gep(given[source], [constant(i)]))

    def _place(self, name: str, row: int) -> ir.Value:
        """The address of a member's number in a row of an argument."""
        if (name, row) not in self._rows:
            width = self.arguments["width" if name == "z" else "n_members"]
            with self.builder.goto_entry_block():
                start = self.builder.mul(width, constant(row))
                self._rows[name, row] = self.builder.gep(self.arguments[name], [start])
        return self.builder.gep(self._rows[name, row], [self.member], inbounds=True)

    def _marked(self, instruction: Any, name: str, row: int) -> Any:
        place = f"{name.replace('x', 'X')}.{row}"
        marks = self._distinct.get(place, self._distinct.get("others", {}))
        for mark, metadata in marks.items():
            instruction.set_metadata(mark, metadata)
        return instruction

    def store(self, value: ir.Value, row: int) -> None:
        """Write a result of the member."""
        place = self._place(self._target, row)
        self._marked(self.builder.store(value, place), self._target, row)

    def loop(self, values: Sequence[Value]) -> None:
        """Compute all results of a member, then write them."""
        with cgutils.for_range(self.builder, self.arguments["n_members"]) as loop:
            self.member = loop.index
            for row, value in enumerate(self.emitter.floats(values)):
                self.store(value, row)


class _Stages:
    """The stages that compute the results, which end up in the first rows of the buffer.

    ``dependent`` are the expressions that differ between members. Of the others, those ``before``
    are computed.
    """

    def __init__(
        self, code: _Members, dependent: set[Expression], before: Sequence[Expression]
    ) -> None:
        self._code, self._before, self._values = code, before, code.values
        self._levels: dict[Expression, int] = {}
        for e in sorted_by_number(dependent):  # arguments come first
            levels = [self._levels[a] + is_block(a) for a in e.args if a in self._levels]
            self._levels[e] = max(levels, default=0)
        self._blocks = [e for e in self._levels if is_block(e)]
        self._n = 1 + max((self._levels[e] + is_block(e) for e in dependent), default=0)
        self._rows: dict[object, int] = {}
        for i in range(len(self._values)):
            self._row("result", i)
        self._wanted, self._known = self._plan()
        self._stored = [self._stored_by(stage) for stage in range(self._n)]
        self._buffer: ir.Value | None = None
        self._block = BLOCK

    def _row(self, *key: object) -> int:
        return self._rows.setdefault(key, len(self._rows))

    def _plan(self) -> tuple[list[list[Value]], list[list[Expression]]]:
        """What each stage computes for itself and others, and what it reads."""
        wanted: list[list[Value]] = [[] for _ in range(self._n)]
        wanted[-1] += self._values
        for block in self._blocks:
            wanted[self._levels[block]] += block.args
        known: list[list[Expression]] = [[] for _ in range(self._n)]
        for stage in reversed(range(self._n)):
            known[stage] = self._read(wanted[stage], stage)
            for e in known[stage]:
                if not is_block(e) and e not in wanted[self._levels[e]]:
                    wanted[self._levels[e]].append(e)
        return wanted, known

    def _read(self, roots: Sequence[Value], stage: int) -> list[Expression]:
        """The expressions of earlier stages that those of this stage need, and that have a row.

        Rows hold double-precision numbers; truth values and whole numbers are computed again.
        """
        found: set[Expression] = set()
        seen: set[Expression] = set()
        stack = list(roots)
        while stack:
            e = stack.pop()
            if not isinstance(e, Expression) or e not in self._levels or e in seen:
                continue
            seen.add(e)
            earlier = self._levels[e] < stage and e.op is not None and e.kind == FLOAT
            if is_block(e) or earlier:
                found.add(e)
            else:
                stack += e.args
        return sorted_by_number(found)

    def _stored_by(self, stage: int) -> dict[int, Value]:
        """What a stage writes, and to which rows."""
        read = {e for known in self._known[stage + 1 :] for e in known if not is_block(e)}
        later = sorted_by_number(e for e in read if self._levels[e] == stage)
        stored: dict[tuple, Value] = {(e,): e for e in later}
        for block in self._blocks_of(stage):
            stored |= {(block, i): a for i, a in enumerate(block.args)}
            self._row(block)
        if stage == self._n - 1:
            stored |= {("result", i): value for i, value in enumerate(self._values)}
        return {self._row(*key): value for key, value in stored.items()}

    def _blocks_of(self, stage: int) -> list[Expression]:
        return [block for block in self._blocks if self._levels[block] == stage]

    def emit(self) -> None:
        """The loop over blocks of members."""
        code, build = self._code, self._code.builder
        n = code.arguments["n_members"]
        length = BLOCK if self._blocks else min(BLOCK, max(8, _MAX_BUFFER // len(self._rows)))
        self._buffer = cgutils.alloca_once(build, DOUBLE, size=constant(len(self._rows) * length))
        self._block = length
        with cgutils.for_range_slice(build, constant(0), n, constant(length), INT) as (first, _):
            rest = build.sub(n, first)
            is_whole = build.icmp_signed("<", constant(length), rest)
            size = build.select(is_whole, constant(length), rest)
            for stage in range(self._n):
                self._emit_stage(stage, first, size)
                for block in self._blocks_of(stage):
                    self._call(block, size)
            for row in range(len(self._values)):
                with cgutils.for_range(build, size) as loop:
                    code.member = build.add(first, loop.index)
                    code.store(build.load(self._place(row, loop.index)), row)

    def _emit_stage(self, stage: int, first: ir.Value, size: ir.Value) -> None:
        code, build = self._code, self._code.builder
        code.emitter.keep_only(self._before)
        with cgutils.for_range(build, size) as loop:
            code.member = build.add(first, loop.index)
            for e in self._known[stage]:
                code.emitter.set(e, build.load(self._place(self._row(e), loop.index)))
            stored = self._stored[stage]
            for row, value in zip(stored, code.emitter.floats(stored.values()), strict=True):
                build.store(value, self._place(row, loop.index))

    def _place(self, row: int, j: ir.Value) -> ir.Value:
        at = self._code.builder.add(constant(row * self._block), j)
        return self._code.builder.gep(self._buffer, [at], inbounds=True)

    def _call(self, block: Expression, size: ir.Value) -> None:
        entry = _block_entry(getattr(block.op, "machine_code", ""), len(block.args))
        rows = [*(self._row(block, i) for i in range(len(block.args))), self._row(block)]
        values = [self._buffer, *map(constant, rows), size]
        self._code.module.call(self._code.builder, entry, values)


@lru_cache
def _block_entry(name: str, n_arguments: int) -> EntryPoint:
    """A function of rows of a buffer, compiled once for all systems."""
    rows = [f"row{i}" for i in range(n_arguments + 1)]
    given = ", ".join(f"np.uint64({row})" for row in rows)
    source = (
        f"def call(buffer, {', '.join(rows)}, size):\n"
        f"    block(carray(buffer, (1, {BLOCK})), {given}, size)"
    )
    scope: dict[str, Any] = {
        "np": np, "carray": carray, "block": BLOCKS[name], "__name__": __name__
    }  # fmt: skip
    exec(source, scope)
    arguments: Mapping[str, Any] = {
        "buffer": F64_PTR, **dict.fromkeys(rows, types.intp), "size": types.intp
    }  # fmt: skip
    return EntryPoint(scope["call"], arguments, name, (source,))
