"""Adding Gaussians to a grid, and weighting a grid by them, in SIMD vectors.

The Gaussian around y is exp(-(g - y)^2 / (2 VARIANCE)). It is evaluated on a window: the `POINTS`
grid points g next to y, `REACH` at or below y and as many above. With r the distance from the last
point at or below y up to y, in grid spacings, its values at j = 0 .. POINTS - 1 are
lead * ratio**j * GROWTH[j],

    lead = exp(-STEEPNESS (REACH - 1 + r)^2 / 2)    and    ratio = exp(STEEPNESS (r - 1)),

two exponentials and a table instead of one exponential per point. In two directions the values are
products of two such. The code is written in LLVM vectors of four numbers, because the loops are too
short for the compiler to vectorise.
"""

import math

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

VARIANCE = 0.2
SPACING = math.sqrt(VARIANCE * (1.0 - VARIANCE)) / 1.075  # sets the error, see `gridded_sum`
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


def _gaussian(b, lead, ratio):
    """The values lead * ratio**j * GROWTH[j] on a window, as vectors."""
    square = b.fmul(ratio, ratio)
    values = _constant([1.0] * LANES)
    for lane, power in ((1, ratio), (2, square), (3, b.fmul(square, ratio))):
        values = b.insert_element(values, power, _INT32(lane))
    values = b.fmul(values, _repeat(b, lead))
    step = _repeat(b, b.fmul(square, square))
    gaussian = []
    for j in range(0, POINTS, LANES):
        gaussian.append(b.fmul(values, _constant(_GROWTH[j : j + LANES])))
        values = b.fmul(values, step)
    return gaussian


def _for_rows(context, b, signature, arguments, directions, visit):
    """Call ``visit`` with the addresses of each row's vectors and its factor; return the values."""
    array, at, stride, lead, ratio, lead_across, ratio_across = arguments
    grid = context.make_array(signature.args[0])(context, b, array).data
    gaussian = _gaussian(b, lead, ratio)

    def visit_row(start, height):
        starts = [b.add(start, _INT64(j)) for j in range(0, POINTS, LANES)]
        visit([_address(b, grid, point) for point in starts], _repeat(b, height), gaussian)

    if directions == 1:
        visit_row(at, lead_across)
        return gaussian
    heights = cgutils.alloca_once(b, _DOUBLE, POINTS)
    for j, values in enumerate(_gaussian(b, lead_across, ratio_across)):
        b.store(values, _address(b, heights, _INT64(LANES * j)), align=8)
    with cgutils.for_range(b, _INT64(POINTS)) as rows:
        height = b.load(b.gep(heights, [rows.index]))
        visit_row(b.add(at, b.mul(rows.index, stride)), height)
    return gaussian


def _add_window(directions):
    def generate(context, b, signature, arguments):
        def visit(addresses, height, gaussian):
            for address, values in zip(addresses, gaussian, strict=True):
                old = b.load(address, align=8)
                b.store(_multiply_add(b, height, values, old), address, align=8)

        _for_rows(context, b, signature, arguments, directions, visit)
        return context.get_dummy_value()

    @intrinsic
    def add_window(typing, grid, at, stride, lead, ratio, lead_across, ratio_across):
        numbers = [types.int64] * 2 + [types.float64] * 4
        return types.void(grid, *numbers), generate

    return add_window


def _sum_window(directions):
    def generate(context, b, signature, arguments):
        columns = [cgutils.alloca_once_value(b, _ZERO) for _ in range(0, POINTS, LANES)]

        def visit(addresses, height, gaussian):
            for column, address in zip(columns, addresses, strict=True):
                values = b.load(address, align=8)
                b.store(_multiply_add(b, height, values, b.load(column)), column)

        gaussian = _for_rows(context, b, signature, arguments, directions, visit)
        total = _ZERO
        for values, column in zip(gaussian, columns, strict=True):
            total = _multiply_add(b, values, b.load(column), total)
        w, x, y, z = _scalars(b, total)
        return b.fadd(b.fadd(w, x), b.fadd(y, z))

    @intrinsic
    def sum_window(typing, grid, at, stride, lead, ratio, lead_across, ratio_across):
        numbers = [types.int64] * 2 + [types.float64] * 4
        return types.float64(grid, *numbers), generate

    return sum_window


def taps_sum(taps):
    """Intrinsic (grid, at, step, out, to): `LANES` outputs of a symmetric convolution.

    ``taps`` are the middle weight and those on one side; the points are ``step`` apart.
    """

    def generate(context, b, signature, arguments):
        array, at, step, out_array, to = arguments
        grid = context.make_array(signature.args[0])(context, b, array).data
        out = context.make_array(signature.args[3])(context, b, out_array).data
        total = b.fmul(_constant([taps[0]] * LANES), b.load(_address(b, grid, at), align=8))
        below = above = at
        for tap in taps[1:]:
            below, above = b.sub(below, step), b.add(above, step)
            pair = [b.load(_address(b, grid, point), align=8) for point in (below, above)]
            total = _multiply_add(b, _constant([tap] * LANES), b.fadd(*pair), total)
        b.store(total, _address(b, out, to), align=8)
        return context.get_dummy_value()

    @intrinsic
    def convolve(typing, grid, at, step, out, to):
        return types.void(grid, types.int64, types.int64, out, types.int64), generate

    return convolve


add_to_line, add_to_plane = _add_window(1), _add_window(2)
"""(grid, at, stride, lead, ratio, lead_across, ratio_across): add a Gaussian to a flat grid.

``at`` is the first point of the window, ``stride`` the distance between rows; there is no bounds
check. On a line ``lead_across`` is a factor, and ``ratio_across`` is not used.
"""

sum_line, sum_plane = _sum_window(1), _sum_window(2)
"""The same arguments: the sum of the grid times the Gaussian."""
