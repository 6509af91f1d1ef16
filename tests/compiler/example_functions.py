"""Functions as users write them, each of a vector of three numbers, to be lowered and compared."""

import numpy as np
import pytensor
import pytensor.tensor as pt

A = np.arange(9.0).reshape(3, 3) / 7.0 + np.eye(3)


def _positive(x):
    """A positive definite matrix."""
    root = pt.stack([[1.0 + x[0] ** 2, 0, 0], [x[1], 2, 0], [x[2], x[0], 3.0 + x[1] ** 2]])
    return root @ root.T


def _lopsided(x):
    """A matrix whose largest pivots are not on the diagonal."""
    return pt.stack([[0.1 * x[0], 2.0, x[1]], [3.0 + x[2], 0.2, 1.0], [x[0], x[1], 4.0]])


def _unpacked(x):
    a, b, c = x
    return [a * b, c, a]


def _gradient(function):
    return lambda x: pytensor.grad(function(x), x)


def _number(x):
    """0, 1 or 2."""
    return pt.cast(pt.floor(1.5 * abs(x[0])) % 3, "int64")


def _chosen(x):
    """An element whose place depends on the values, also from the end."""
    return x[_number(x) - 2]


MOVING = {
    "roll": lambda x: pt.roll(x, 1),
    "roll back": lambda x: pt.roll(x, -2) * x,
    "slices": lambda x: x[1:] - x[:-1],
    "reversed": lambda x: x[::-1],
    "set": lambda x: pt.set_subtensor(x[1], x[0] ** 2),
    "set method": lambda x: x[1:].set(pt.exp(x[1:])),
    "increase": lambda x: pt.inc_subtensor(x[:2], x[1:]),
    "increase twice": lambda x: pt.inc_subtensor(x[[0, 0, 1]], x),
    "index list": lambda x: x[[2, 0]],
    "index by a value": lambda x: A[0, 1] * _chosen(x) + pt.as_tensor(A)[:, _number(x)],
    "row by a value": lambda x: pt.as_tensor(A)[_number(x) - 3, 1:] + x[_number(x)],
    "derivative of a choice": _gradient(lambda x: x[_number(x)] ** 2 + (x * _chosen(x)).sum()),
    "stack": lambda x: pt.stack([x[0], x[2]]),
    "concatenate": lambda x: pt.concatenate([x, x**2]),
    "unpacked": _unpacked,
    "iterated": lambda x: [2.0 * component for component in x],
    "reshape": lambda x: x.reshape((3, 1)).T.ravel(),
    "moveaxis": lambda x: pt.moveaxis(x[None, :], 0, 1).ravel(),
    "repeat": lambda x: pt.concatenate([pt.repeat(x, 2), pt.tile(x, 2)]),
    "diff": lambda x: pt.diff(x),
    "constants": lambda x: [1, 2.5, np.float32(3), x[0] * 0],
    "tril": lambda x: pt.tril(_positive(x)).ravel(),
    "diagonal": lambda x: pt.concatenate([pt.diag(x).ravel(), pt.diagonal(_positive(x))]),
    "eye": lambda x: (pt.eye(3) * x[0] + pt.ones((3, 3)) * x).ravel(),
}

ARITHMETIC = {
    "whole powers": lambda x: pt.concatenate([x**k for k in (-2, -1, 0, 1, 2, 3, 7, 16, 17)]),
    "other powers": lambda x: pt.concatenate([abs(x) ** 2.5, abs(x) ** -0.5, 2**x, abs(x) ** x]),
    "root of negative": lambda x: x**0.5,
    "whole numbers": lambda x: 3 / 2 * x + x / 3 + 7 // 2,
    "integer tensors": lambda x: x * (pt.arange(3) + 1) / np.array([1, 2, 3]) + pt.arange(3) // 2,
    "division": lambda x: x // 0.3 + x % -0.7 + pt.mod(x, 0.3),
    "rounding": lambda x: pt.round(x * 3) + pt.floor(x * 3) + pt.ceil(x) + pt.trunc(x * 3),
    "elementary": lambda x: pt.concatenate([
        pt.exp(x), pt.log(abs(x)), pt.sin(x), pt.cos(x), pt.tanh(x), pt.sigmoid(x),
        pt.softplus(x), pt.erf(x), pt.erfc(x), pt.log1p(abs(x)), pt.expm1(x), pt.arctan(x),
        pt.sqrt(abs(x)), pt.sinh(x), pt.arcsinh(x),
    ]),
    "several arguments": lambda x: pt.concatenate([
        pt.arctan2(x, x[::-1]), pt.maximum(x, 0), pt.minimum(x, x[1]), pt.logaddexp(x, x[::-1]),
    ]),
    "gamma": lambda x: pt.gammaln(abs(x) + 1) + pt.psi(abs(x) + 1),
    "abs and sign": lambda x: pt.abs(x) * pt.sign(x) + abs(x[0]),
    "clip": lambda x: pt.clip(x, -0.5, 0.5),
    "sums": lambda x: [x.sum(), pt.mean(x), pt.prod(x), pt.var(x), pt.max(x) - pt.min(x)],
    "sums of rows": lambda x: _positive(x).sum(axis=0) + _positive(x).max(axis=1) + pt.mean(x),
}  # fmt: skip

LOGIC = {
    "switch": lambda x: pt.switch(x > 0.1, x, -(x**2)),
    "nested switch": lambda x: pt.where((x > 0) & (x < 1) | (x < -1), 1, pt.switch(x > 2, x, 3)),
    "truth times number": lambda x: (x > 0) * x + 1.0 * (x > 0) * (x < 1),
    "truth plus truth": lambda x: (x > 0) + (x < 1),
    "truth times truth": lambda x: 2 * ((x > 0) * (x < 1)),
    "counted": lambda x: [pt.sum(x > 0), pt.sum((x > 0) * 1.0), pt.mean(x > 0)],
    "any and all": lambda x: [pt.any(x > 0), pt.all(x > 0)],
    "not and or": lambda x: ~(x > 0) + 2 * ((x > 0) ^ (x < 1)),
    "equal": lambda x: pt.eq(x, x[0]) + 2 * pt.neq(x, x[1]),
    "cast": lambda x: pt.cast(x * 10, "int64") / 3 + pt.cast(x, "bool"),
    "not finite": lambda x: pt.isnan(x) * 1 + pt.isinf(x) * 2,
}

ALGEBRA = {
    "matrix vector": lambda x: A @ x + x @ A + A @ _positive(x) @ x,
    "products": lambda x: pt.concatenate([pt.outer(x, x).ravel(), pt.dot(x, x)[None]]),
    "einsum": lambda x: pt.einsum("i,ij->j", x, _positive(x)) + pt.tensordot(x, A, axes=1),
    "batched": lambda x: (pt.stack([_positive(x), A]) @ pt.stack([_positive(x), A])).ravel(),
    "cholesky": lambda x: pt.linalg.cholesky(_positive(x)).ravel(),
    "upper cholesky": lambda x: pt.linalg.cholesky(_positive(x), lower=False).ravel(),
    "solve lower": lambda x: pt.linalg.solve_triangular(A * pt.eye(3), _positive(x)).ravel(),
    "solve transposed": lambda x: pt.linalg.solve_triangular(
        pt.linalg.cholesky(_positive(x)), x, lower=True, trans=1
    ),
}

NESTED = {
    "softmax": lambda x: pt.special.softmax(x) + pt.special.log_softmax(x),
    "logsumexp": lambda x: [pt.logsumexp(x)],
    "vectorize": lambda x: pt.vectorize(lambda a: a**2, signature="()->()")(x),
    "gradient of softmax": _gradient(lambda x: (pt.special.softmax(x) * np.arange(3)).sum()),
    "gradient of logsumexp": _gradient(pt.logsumexp),
    "gradient of cholesky": _gradient(lambda x: pt.linalg.cholesky(_positive(x)).sum()),
    "gradient of kinks": _gradient(lambda x: pt.max(x) + abs(x).sum() + pt.clip(x, -1, 1).sum()),
    "gradient of products": _gradient(lambda x: (pt.exp(x) * x[::-1]).sum()),
}

SOLVED = {
    "solve": lambda x: pt.linalg.solve(_positive(x), x),
    "solve two": lambda x: pt.linalg.solve(_positive(x)[:2, :2], _positive(x)[:2]).ravel(),
    "solve one": lambda x: pt.linalg.solve(x[2:, None], x[:1]),
    "solve positive": lambda x: pt.linalg.solve(_positive(x), x, assume_a="pos"),
    "solve symmetric": lambda x: pt.linalg.solve(_lopsided(x), x, assume_a="sym"),
    "solve lower symmetric": lambda x: pt.linalg.solve(
        _lopsided(x), _positive(x), assume_a="sym", lower=True
    ).ravel(),
    "solve tridiagonal": lambda x: pt.linalg.solve(
        _positive(x) * np.tri(3, k=1) * np.tri(3, k=1).T, x, assume_a="tridiagonal"
    ),
    "solve diagonal": lambda x: pt.linalg.solve(_positive(x), x, assume_a="diagonal"),
    "solve transposed general": lambda x: pt.linalg.solve(_lopsided(x), x, transposed=True),
    "no first pivot": lambda x: pt.linalg.solve(
        pt.stack([[0.0, x[0], 2.0], [1.0, 0.0, 0.0], [x[2], 0.0, 5.0]]), x
    ),
    "inverse": lambda x: pt.linalg.inv(_positive(x)).ravel(),
    "inverse of lopsided": lambda x: pt.linalg.inv(_lopsided(x)).ravel(),
    "determinant": lambda x: pt.stack(
        [pt.linalg.det(_positive(x)), pt.linalg.det(_lopsided(x)), pt.linalg.det(A[:2, :2] * x[0])]
    ),
    "cho_solve": lambda x: pt.linalg.cho_solve((pt.linalg.cholesky(_positive(x)), True), x),
    "upper cho_solve": lambda x: pt.linalg.cho_solve(
        (pt.linalg.cholesky(_positive(x), lower=False), False), x
    ),
    "gradient of solve": _gradient(lambda x: pt.linalg.solve(_lopsided(x), x).sum()),
    "gradient of inverse": _gradient(lambda x: pt.linalg.inv(_lopsided(x)).sum()),
    "gradient of determinant": _gradient(lambda x: pt.log(pt.abs(pt.linalg.det(_lopsided(x))))),
}

# What has no scalar form goes through array code.
ARRAYS_ONLY = {
    "eigenvalues": lambda x: pt.linalg.eigvalsh(_positive(x)),
    "cumsum": lambda x: pt.cumsum(x),
    "sort": lambda x: pt.sort(x),
    "index by value": lambda x: x[pt.argmax(x)][None],
    "scan": lambda x: pytensor.scan(
        lambda c, s: s * c, sequences=x, outputs_info=pt.ones(()), return_updates=False
    ),
}

UNROLLED = MOVING | ARITHMETIC | LOGIC | ALGEBRA | SOLVED | NESTED
