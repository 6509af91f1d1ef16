"""Loops over members in stages, around functions that have branches.

A loop with a branch does not vectorise. So a function of `BLOCKS` divides a loop in two: one stage
computes its arguments for a block of members, into rows of a buffer; the function maps these rows
to another one; the next stage goes on with that. What a stage needs of earlier ones is kept in rows
too.
"""

from collections.abc import Sequence

from pymc_statespace_filters.compiler.codegen.expressions import FLOAT, Expression, Value
from pymc_statespace_filters.compiler.codegen.source import BLOCKS, Writer

BLOCK = 64


def is_block(value: Value) -> bool:
    """Whether a value is the result of a function with branches."""
    return isinstance(value, Expression) and getattr(value.op, "machine_code", None) in BLOCKS


class Stages:
    """The stages that compute ``values``, whose results end up in the first rows of the buffer.

    ``dependent`` are the expressions that differ between members. Of the others, those ``before``
    are known, by the names that the writer gave them.
    """

    def __init__(
        self,
        writer: Writer,
        values: Sequence[Value],
        dependent: set[Expression],
        before: Sequence[Expression],
    ) -> None:
        self._writer, self._before, self._names = writer, before, list(map(writer.name, before))
        self._levels: dict[Expression, int] = {}
        for e in sorted(dependent, key=lambda e: e.number):  # arguments come first
            levels = [self._levels[a] + is_block(a) for a in e.args if a in self._levels]
            self._levels[e] = max(levels, default=0)
        self._blocks = [e for e in self._levels if is_block(e)]
        self._n = 1 + max(self._levels[e] + is_block(e) for e in dependent)
        self._values = values
        self._rows: dict[object, int] = {}
        for i in range(len(values)):
            self._row("result", i)
        self._wanted, self._known = self._plan()
        self.inside = [self._lines(stage) for stage in range(self._n)]
        self.n_rows = len(self._rows)

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
        return sorted(found, key=lambda e: e.number)

    def _lines(self, stage: int) -> list[str]:
        """The code inside the loop of a stage."""
        writer = self._writer
        writer.keep_only(self._before)
        lines = [f"{name} = common[{i}]" for i, name in enumerate(self._names)]
        lines += [writer.read(e, f"buffer[{self._row(e)}, j]") for e in self._known[stage]]
        lines += writer.statements(self._wanted[stage])
        stored: dict[tuple, Value] = {(e,): e for e in self._later(stage)}
        for block in self._blocks_of(stage):
            stored |= {(block, i): a for i, a in enumerate(block.args)}
        if stage == self._n - 1:
            stored |= {("result", i): value for i, value in enumerate(self._values)}
        for key, value in stored.items():
            lines.append(f"buffer[{self._row(*key)}, j] = {writer.as_float(value)}")
        return lines

    def _later(self, stage: int) -> list[Expression]:
        """What this stage computes and others read."""
        read = {e for known in self._known[stage + 1 :] for e in known}
        return [
            e
            for e in sorted(read, key=lambda e: e.number)
            if self._levels[e] == stage and not is_block(e)
        ]

    def _blocks_of(self, stage: int) -> list[Expression]:
        return [block for block in self._blocks if self._levels[block] == stage]

    def body(self, arguments: str, target: str) -> list[str]:
        """The loop over blocks of members, which calls ``stage_i(arguments)``."""
        whole = target.partition("[")[0]
        block = [f"size = min({BLOCK}, {whole}.shape[-1] - first)"]
        for stage in range(self._n):
            block += ["for j in range(size):", f"    stage_{stage}({arguments})"]
            block += [self._call(called) for called in self._blocks_of(stage)]
        block += [
            f"for i in range({len(self._values)}):",
            "    for j in range(size):",
            f"        {target.format(i='i').replace('member', 'np.uint64(first + j)')} "
            f"= buffer[i, j]",
        ]
        return [
            f"buffer = np.empty(({self.n_rows}, {BLOCK}))",
            f"for first in range(0, {whole}.shape[-1], {BLOCK}):",
            *(f"    {line}" for line in block),
        ]

    def _call(self, block: Expression) -> str:
        assert block.op is not None
        rows = [*(self._row(block, i) for i in range(len(block.args))), self._row(block)]
        function = BLOCKS[getattr(block.op, "machine_code", "")].py_func.__name__
        return f"{function}(buffer, {', '.join(f'np.uint64({row})' for row in rows)}, size)"
