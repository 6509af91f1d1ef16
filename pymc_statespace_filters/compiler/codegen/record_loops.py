"""The loops of a filter along one record, with the filter's state in registers.

Every step waits for the one before, so that a loop that passes the state through memory, or calls a
function for every row, takes up to four times as long.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from llvmlite import ir

from ..native.entry_point import F64_PTR
from .arguments import ALONG_ARGUMENTS
from .emitter import Emitter
from .machine_code import BOOL, DOUBLE, Code, Module, constant
from .simd import Written

_ADDRESSES = [name for name, kind in ALONG_ARGUMENTS.items() if kind is F64_PTR]


class Sizes(NamedTuple):
    """Lengths of vectors, and the row of ``W`` for the number of rows or for the cotangents."""

    state: int
    inputs: int
    noises: int
    observables: int
    result: int


def forward_loop(step: Written, row: Written, carried: Sequence[str], sizes: Sizes) -> Code:
    """The code of `ALONG_ARGUMENTS`: from the state at ``states`` on, write terms and states.

    It writes the state before each step and each row, and the last one. The result is the number of
    rows before the first without a finite state and term; its term is
    written too. ``carried`` are the names of elements.
    The values of a step are theirs; behind those of a row is the term of an update.
    """
    builder = _Builder(step, row, carried, sizes)
    builder.forward()
    return builder.module.finished()


def backward_loop(step: Written, row: Written, carried: Sequence[str], sizes: Sizes) -> Code:
    """The same, from the end of a tape back, for the cotangents ``terms``.

    What is carried is zero at first, and is the result.
    """
    builder = _Builder(step, row, carried, sizes)
    builder.backward()
    return builder.module.finished()


class _Builder:
    """Builds the loops."""

    def __init__(self, step: Written, row: Written, carried: Sequence[str], sizes: Sizes) -> None:
        self.module, self._step, self._row, self._sizes = Module(), step, row, sizes
        self._carried = {name: i for i, name in enumerate(carried)}
        self._build, self._given = self.module.main(ALONG_ARGUMENTS)
        self._distinct = self.module.distinct(_ADDRESSES)

    def forward(self) -> None:
        """Loops over rows, and over the steps up to each."""
        build, given, zero = self._build, self._given, constant(0)
        begun = [self._access("states", zero, i) for i in range(len(self._carried))]
        rows, row, at_row, finish, failed = self._blocks(
            "rows", "row", "at_row", "finish", "failed"
        )
        steps, step, missing, seen, known, following = self._blocks(
            "steps", "step", "missing", "seen", "known", "following"
        )
        entered = build.block
        build.branch(rows)

        build.position_at_end(rows)
        j, k, place = (self._phi(x, entered) for x in (zero, given["first"], zero))
        state = [self._phi(x, entered) for x in begun]
        build.cbranch(build.icmp_signed("<", j, given["n_rows"]), row, finish)

        build.position_at_end(row)
        until = self._step_of(j)
        build.branch(steps)

        build.position_at_end(steps)
        inner_k, inner_place = self._phi(k, row), self._phi(place, row)
        inner = [self._phi(x, row) for x in state]
        self._store_state(inner, inner_place)
        build.cbranch(build.icmp_signed("<", inner_k, until), step, at_row)

        build.position_at_end(step)
        after = self._emit(self._step, inner, inner_k, inner_place, None)
        next_place = build.add(inner_place, given["stride"])
        self._join(
            build.block, (inner_k, build.add(inner_k, constant(1))),
            (inner_place, next_place), *zip(inner, after, strict=True),
        )  # fmt: skip
        build.branch(steps)

        build.position_at_end(at_row)
        build.cbranch(self._is_missing(j), missing, seen)

        build.position_at_end(missing)
        self._access("terms", j, 0, ir.Constant(DOUBLE, 0.0))
        build.branch(following)

        build.position_at_end(seen)
        *updated, term = self._emit(self._row, inner, inner_k, inner_place, j)
        build.cbranch(self._are_finite([term, *inner]), known, failed)

        build.position_at_end(known)
        self._access("terms", j, 0, term)
        build.branch(following)

        build.position_at_end(following)
        left = [self._phi(x, missing) for x in inner]
        self._join(known, *zip(left, updated, strict=True))
        self._join(
            following, (j, build.add(j, constant(1))), (k, inner_k),
            (place, build.add(inner_place, given["stride"])), *zip(state, left, strict=True),
        )  # fmt: skip
        build.branch(rows)

        build.position_at_end(failed)
        self._access("terms", j, 0, term)
        ended = build.append_basic_block("ended")
        build.branch(ended)
        build.position_at_end(finish)
        self._store_state(state, place)
        build.branch(ended)
        build.position_at_end(ended)
        result = self._phi(j, failed)
        self._join(finish, (result, given["n_rows"]))
        self._access("W", constant(self._sizes.result), 0, build.sitofp(result, DOUBLE))
        build.ret_void()

    def backward(self) -> None:
        """Loops over rows from the last on, and over the steps before each."""
        build, given, zero, one = self._build, self._given, constant(0), constant(1)
        rows, row, seen, before, steps, step, following, finish = self._blocks(
            "rows", "row", "seen", "before", "steps", "step", "following", "finish"
        )
        n_rows = given["n_rows"]
        last = self._step_of(build.sub(n_rows, one))
        size = constant(self._sizes.state)
        end = build.mul(build.add(last, n_rows), size)
        entered = build.block
        build.branch(rows)

        build.position_at_end(rows)
        j, k, place = (self._phi(x, entered) for x in (n_rows, last, end))
        bars = [self._phi(ir.Constant(DOUBLE, 0.0), entered) for _ in range(len(self._carried))]
        build.cbranch(build.icmp_signed(">", j, zero), row, finish)

        build.position_at_end(row)
        at = build.sub(j, one)
        row_place = build.sub(place, size)
        build.cbranch(self._is_missing(at), before, seen)

        build.position_at_end(seen)
        updated = self._emit(self._row, bars, k, row_place, at)
        seen_to = build.block
        build.branch(before)

        build.position_at_end(before)
        joined = [self._phi(x, row) for x in bars]
        self._join(seen_to, *zip(joined, updated, strict=True))
        is_first = build.icmp_signed("==", at, zero)
        earlier = self._step_of(build.select(is_first, zero, build.sub(at, one)))
        origin = build.select(is_first, zero, earlier)
        build.branch(steps)

        build.position_at_end(steps)
        inner_k, inner_place = self._phi(k, before), self._phi(row_place, before)
        inner = [self._phi(x, before) for x in joined]
        build.cbranch(build.icmp_signed(">", inner_k, origin), step, following)

        build.position_at_end(step)
        step_k, step_place = build.sub(inner_k, one), build.sub(inner_place, size)
        after = self._emit(self._step, inner, step_k, step_place, None)
        self._join(
            build.block, (inner_k, step_k), (inner_place, step_place),
            *zip(inner, after, strict=True),
        )  # fmt: skip
        build.branch(steps)

        build.position_at_end(following)
        self._join(
            following, (j, at), (k, inner_k), (place, inner_place), *zip(bars, inner, strict=True)
        )
        build.branch(rows)

        build.position_at_end(finish)
        for i, bar in enumerate(bars):
            self._access("W", constant(self._sizes.result), i, bar)
        build.ret_void()

    def _blocks(self, *names: str) -> list[ir.Block]:
        return [self._build.append_basic_block(name) for name in names]

    def _phi(self, value: ir.Value, block: ir.Block) -> Any:
        phi = self._build.phi(value.type)
        phi.add_incoming(value, block)
        return phi

    def _join(self, block: ir.Block, *pairs: tuple[Any, ir.Value]) -> None:
        for phi, value in pairs:
            phi.add_incoming(value, block)

    def _emit(
        self, part: Written, carried: Sequence[ir.Value], k: ir.Value, place: ir.Value, j: Any
    ) -> list[ir.Value]:
        """Emit a step or a row, with the state at a place of the tape."""
        build, given, sizes = self._build, self._given, self._sizes
        firsts = {
            "theta": ("W", constant(0)), "s": ("states", place),
            "u": ("inputs", build.mul(k, constant(sizes.inputs))),
            "z": ("noises", build.mul(k, constant(sizes.noises))),
        }  # fmt: skip
        if j is not None:
            datum = build.mul(j, constant(sizes.observables))
            firsts |= {"d": ("observed", datum), "term_bar": ("terms", j)}

        def read(name: str) -> ir.Value:
            if name in self._carried:
                return carried[self._carried[name]]
            vector, _, i = name.partition(".")
            return time if vector == "t" else self._access(*firsts[vector], int(i))

        emitter = Emitter(self.module, build, read, vector=False)
        elapsed = emitter.arithmetic("fmul", build.sitofp(k, DOUBLE), given["dt"])
        time = emitter.arithmetic("fadd", given["t0"], elapsed)
        for value, row in part.known.items():
            emitter.set(value, self._access("W", constant(0), row))
        return emitter.floats(part.values)

    def _access(self, name: str, first: ir.Value, i: int, value: Any = None) -> Any:
        """Read an element of an array, or write a value to it."""
        build, index = self._build, self._build.add(first, constant(i))
        address = build.gep(self._given[name], [index])
        made = build.load(address) if value is None else build.store(value, address)
        for mark, metadata in self._distinct[name].items():
            made.set_metadata(mark, metadata)
        return made

    def _store_state(self, state: Sequence[ir.Value], place: ir.Value) -> None:
        for i, x in enumerate(state):
            self._access("states", place, i, x)

    def _step_of(self, j: ir.Value) -> ir.Value:
        at = self._build.mul(j, self._given["row_width"])
        return self._build.load(self._build.gep(self._given["steps"], [at]))

    def _is_missing(self, j: ir.Value) -> ir.Value:
        build, p = self._build, self._sizes.observables
        first, missing = build.mul(j, constant(p)), ir.Constant(BOOL, 1)
        for i in range(p):
            d = self._access("observed", first, i)
            missing = build.and_(missing, build.fcmp_unordered("!=", d, d))
        return missing

    def _are_finite(self, values: Sequence[ir.Value]) -> ir.Value:
        build, finite = self._build, ir.Constant(BOOL, 1)
        size = self.module.declared("llvm.fabs.f64", [DOUBLE], DOUBLE)
        infinite = ir.Constant(DOUBLE, float("inf"))
        for value in values:
            is_finite = build.fcmp_ordered("<", build.call(size, [value]), infinite)
            finite = build.and_(finite, is_finite)
        return finite
