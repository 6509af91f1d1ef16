"""Nanoseconds for a draw of a count or a gamma variable inside ``propagate``, and by numpy.

``python -m benchmarks.draws`` prints a table. The normals are given; numpy makes its own bits.
"""

import time

import numpy as np

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.system import quantiles

N, ROUNDS, DRAWS = 2000, 200, 4
MEANS = (1e-3, 0.1, 1.0, 4.0, 7.0, 9.0, 20.0, 100.0, 1e4, 1e6, 1e9)
SHAPES = (1e-2, 0.1, 0.5, 1.0, 3.0, 10.0, 30.0, 100.0, 1e4, 1e6)


def system(draw):
    """Four draws in a step, with the parameters a member has: x[0] and x[1]."""
    return psf.StateSpaceModel(
        transition=lambda x, q, a: [
            x[0], x[1], x[2] + sum(draw(q[i], x[0], x[1]) for i in range(DRAWS)) * a,
        ],
        process_noise=np.eye(DRAWS),
        observation=lambda x: [x[2]],
        observation_noise=[[1.0]],
        initial_mean=[1.0, 1.0, 0.0],
        initial_cov=np.zeros((3, 3)),
    )  # fmt: skip


LAWS = {
    "poisson": system(lambda z, x, y: quantiles.poisson_quantile(z, x)),
    "binomial": system(lambda z, x, y: quantiles.binomial_quantile(z, x, y)),
    "gamma": system(lambda z, x, y: quantiles.gamma_quantile(z, x, 1.0)),
    "nothing": system(lambda z, x, y: z),
}


def nanoseconds(run, draws):
    """CPU time of the fastest of five rounds, for each draw."""
    times = []
    for _ in range(5):
        start = time.process_time_ns()
        for _ in range(ROUNDS // 5):
            run()
        times.append((time.process_time_ns() - start) / (ROUNDS // 5) / draws)
    return min(times)


def ours(law, first, second):
    machine = compile_system(LAWS[law])
    c = machine.prepare.function(np.array([1.0]))
    rng = np.random.default_rng(0)
    width = -(-N // 64) * 64
    X, Z = np.array([first, second, np.zeros(N)]), rng.normal(size=(DRAWS, width))
    function = machine.propagate.function
    return nanoseconds(lambda: function(c, np.zeros((0, 0)), 0, 0.0, Z, X), N * DRAWS)


def main():
    rng = np.random.default_rng(1)
    spread = rng.uniform(0.9, 1.1, N)
    nothing = ours("nothing", spread, spread)
    print(f"{'':>12}{'poisson':>9}{'numpy':>7}{'binomial':>10}{'numpy':>7}")
    for mean in MEANS:
        n, p = np.ceil(mean * spread / 0.3), rng.uniform(0.29, 0.31, N)
        n_int = n.astype(np.int64)
        row = [
            ours("poisson", mean * spread, spread) - nothing,
            nanoseconds(lambda m=mean: rng.poisson(m * spread), N),
            ours("binomial", n, p) - nothing,
            nanoseconds(lambda n=n_int, p=p: rng.binomial(n, p), N),
        ]
        print(f"mean {mean:<7g}{row[0]:9.1f}{row[1]:7.1f}{row[2]:10.1f}{row[3]:7.1f}")
    print(f"{'':>12}{'gamma':>9}{'numpy':>7}")
    for shape in SHAPES:
        row = [
            ours("gamma", shape * spread, spread) - nothing,
            nanoseconds(lambda s=shape: rng.gamma(s * spread), N),
        ]
        print(f"shape {shape:<6g}{row[0]:9.1f}{row[1]:7.1f}")


if __name__ == "__main__":
    main()
