"""Windows: Gaussian bells on the points of a lattice, in vector registers.

A bell is exp(-(g - y)^2 / (2 VARIANCE)), y its centre. Its window are the `POINTS` lattice points g
next to y: `REACH` that are not above y, and as many that are. If r is how far y is above the last
of the former, in lattice points, the bell is lead * ratio**j * GROWTH[j] at j = 0 .. POINTS - 1,

    lead = exp(-STEEPNESS (REACH - 1 + r)^2 / 2)    and    ratio = exp(STEEPNESS (r - 1)),

two exponentials and a table instead of an exponential a point. In two directions a bell is the
product of two. Here bells are added to a lattice, and the lattice is summed under them, in LLVM's
vectors of four numbers: the loops are too short for the compiler to find these by itself.
"""

import math

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

VARIANCE = 0.2
SPACING = math.sqrt(VARIANCE * (1.0 - VARIANCE)) / 1.075  # `_lattice_sum` says what follows
STEEPNESS = SPACING**2 / VARIANCE
POINTS, REACH = 20, 10
LANES = 4

_GROWTH = [math.exp(STEEPNESS * j * (REACH - 0.5 * j)) for j in range(POINTS)]
_DOUBLE, _INT32, _INT64 = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_ZERO = ir.Constant(_VECTOR, [0.0] * LANES)


def _constant(values):
    return ir.Constant(_VECTOR, list(values))


def _repeat(b, x):
    """A vector of x, four times."""
    first = b.insert_element(ir.Constant(_VECTOR, ir.Undefined), x, _INT32(0))
    lanes = ir.Constant(ir.VectorType(_INT32, LANES), [0] * LANES)
    return b.shuffle_vector(first, first, lanes)


def _multiply_add(b, x, y, z):
    return b.fadd(b.fmul(x, y, flags=("contract",)), z, flags=("contract",))


def _address(b, array, at):
    return b.bitcast(b.gep(array, [at]), _VECTOR.as_pointer())


def _scalars(b, vector):
    return [b.extract_element(vector, _INT32(lane)) for lane in range(LANES)]


def _bell(b, lead, ratio):
    """lead * ratio**j * GROWTH[j] for all points of a window, in vectors."""
    square = b.fmul(ratio, ratio)
    values = _constant([1.0] * LANES)
    for lane, power in ((1, ratio), (2, square), (3, b.fmul(square, ratio))):
        values = b.insert_element(values, power, _INT32(lane))
    values = b.fmul(values, _repeat(b, lead))
    step = _repeat(b, b.fmul(square, square))
    bell = []
    for j in range(0, POINTS, LANES):
        bell.append(b.fmul(values, _constant(_GROWTH[j : j + LANES])))
        values = b.fmul(values, step)
    return bell


def _for_rows(context, b, signature, arguments, directions, visit):
    """Call ``visit`` with the addresses of each row's vectors and its height; return the bell."""
    array, at, stride, lead, ratio, lead_across, ratio_across = arguments
    lattice = context.make_array(signature.args[0])(context, b, array).data
    bell = _bell(b, lead, ratio)

    def visit_row(start, height):
        starts = [b.add(start, _INT64(j)) for j in range(0, POINTS, LANES)]
        visit([_address(b, lattice, point) for point in starts], _repeat(b, height), bell)

    if directions == 1:
        visit_row(at, lead_across)
        return bell
    heights = cgutils.alloca_once(b, _DOUBLE, POINTS)
    for j, values in enumerate(_bell(b, lead_across, ratio_across)):
        b.store(values, _address(b, heights, _INT64(LANES * j)), align=8)
    with cgutils.for_range(b, _INT64(POINTS)) as rows:
        height = b.load(b.gep(heights, [rows.index]))
        visit_row(b.add(at, b.mul(rows.index, stride)), height)
    return bell


def _add_window(directions):
    def generate(context, b, signature, arguments):
        def visit(addresses, height, bell):
            for address, values in zip(addresses, bell, strict=True):
                old = b.load(address, align=8)
                b.store(_multiply_add(b, height, values, old), address, align=8)

        _for_rows(context, b, signature, arguments, directions, visit)
        return context.get_dummy_value()

    @intrinsic
    def add_window(typing, lattice, at, stride, lead, ratio, lead_across, ratio_across):
        numbers = [types.int64] * 2 + [types.float64] * 4
        return types.void(lattice, *numbers), generate

    return add_window


def _sum_window(directions):
    def generate(context, b, signature, arguments):
        columns = [cgutils.alloca_once_value(b, _ZERO) for _ in range(0, POINTS, LANES)]

        def visit(addresses, height, bell):
            for column, address in zip(columns, addresses, strict=True):
                values = b.load(address, align=8)
                b.store(_multiply_add(b, height, values, b.load(column)), column)

        bell = _for_rows(context, b, signature, arguments, directions, visit)
        total = _ZERO
        for values, column in zip(bell, columns, strict=True):
            total = _multiply_add(b, values, b.load(column), total)
        w, x, y, z = _scalars(b, total)
        return b.fadd(b.fadd(w, x), b.fadd(y, z))

    @intrinsic
    def sum_window(typing, lattice, at, stride, lead, ratio, lead_across, ratio_across):
        numbers = [types.int64] * 2 + [types.float64] * 4
        return types.float64(lattice, *numbers), generate

    return sum_window


def taps_sum(taps):
    """Intrinsic (lattice, at, step, out, to): LANES sums of the lattice with symmetric weights.

    ``taps`` are the middle one and those on one side, and meet points that are ``step`` apart.
    """

    def generate(context, b, signature, arguments):
        array, at, step, out_array, to = arguments
        lattice = context.make_array(signature.args[0])(context, b, array).data
        out = context.make_array(signature.args[3])(context, b, out_array).data
        total = b.fmul(_constant([taps[0]] * LANES), b.load(_address(b, lattice, at), align=8))
        below = above = at
        for tap in taps[1:]:
            below, above = b.sub(below, step), b.add(above, step)
            pair = [b.load(_address(b, lattice, point), align=8) for point in (below, above)]
            total = _multiply_add(b, _constant([tap] * LANES), b.fadd(*pair), total)
        b.store(total, _address(b, out, to), align=8)
        return context.get_dummy_value()

    @intrinsic
    def convolve(typing, lattice, at, step, out, to):
        return types.void(lattice, types.int64, types.int64, out, types.int64), generate

    return convolve


add_to_line, add_to_plane = _add_window(1), _add_window(2)
"""(lattice, at, stride, lead, ratio, lead_across, ratio_across): add a bell to a flat lattice.

``at`` is the first point of the window, ``stride`` the distance between rows; nothing checks that
the window lies inside. On a line ``lead_across`` is a factor, and ``ratio_across`` is not used.
"""

sum_line, sum_plane = _sum_window(1), _sum_window(2)
"""The same arguments: the sum of the lattice times the bell."""
