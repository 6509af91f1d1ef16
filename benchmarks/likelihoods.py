"""The likelihoods: which contender does which task. Every function is one part of the table."""

import numpy as np

import pymc_statespace_filters as psf
from benchmarks import epidemic as seir
from benchmarks import loops, ours
from benchmarks.cpp import OPTIONS, Cpp
from benchmarks.measure import FOLDER, N_SEEDS, Peers, Row, compare
from benchmarks.timing import Timed

OURS, HELD = "ours", "ours, noise held"
PROPAGATION = "numba loop, propagation alone"
O2, FAST = OPTIONS
N_POINTS = 32


def ekf_by_hand(name: str) -> Timed:
    likelihood = ours.of(name, psf.EKF())
    theta, steps, observed = likelihood.at, likelihood.steps, likelihood.observed
    if name == "double_well":
        return Timed(lambda s: loops.ekf_double_well(theta, steps, observed))
    u = np.ascontiguousarray(likelihood.inputs[:, 0])
    return Timed(lambda s: loops.ekf_mass_spring_damper(theta, steps, observed, u))


def propagation(name: str, n_members: int) -> Timed:
    likelihood = ours.of(name, psf.EnKF(n_members))
    theta, steps = likelihood.at, likelihood.steps
    x, v = np.empty(n_members), np.empty(n_members)

    def draw(seed):
        return np.random.default_rng(seed).standard_normal((2 + steps[-1], n_members))

    if name == "double_well":
        return Timed(lambda z: loops.propagate_double_well(theta, steps, z, x), draw)
    u = np.ascontiguousarray(likelihood.inputs[:, 0])
    return Timed(lambda z: loops.propagate_mass_spring_damper(theta, steps, u, z, x, v), draw)


def ekf_value(peers: Peers, name: str, title: str) -> list[Row]:
    by_ekf = ours.of(name, psf.EKF())
    makers = {
        OURS: by_ekf.value,
        "ours, called from Python": by_ekf.called_from_python,
        f"ours, {N_POINTS} points in one call, each": lambda: by_ekf.batch(N_POINTS),
        "numba loop by hand": lambda: ekf_by_hand(name),
        O2: lambda: Cpp(O2, FOLDER, name, "ekf").deterministic(),
        FAST: lambda: Cpp(FAST, FOLDER, name, "ekf").deterministic(),
        "JAX scan by hand": lambda: peers.task("jax_scan", f"{name}/value"),
        "dynamax": lambda: peers.task("dynamax_ekf", f"{name}/value"),
    }
    if name == "double_well":
        makers["cuthbert"] = lambda: peers.task("cuthbert_filters", f"{name}/value")
        makers["filterpy"] = lambda: peers.task("filterpy_ekf", f"{name}/value")
    return compare(f"EKF, {title}: value", makers)


def ekf_gradient(peers: Peers, name: str, title: str) -> list[Row]:
    makers = {
        OURS: ours.of(name, psf.EKF()).value_and_gradient,
        "JAX scan by hand": lambda: peers.task("jax_scan", f"{name}/gradient"),
        "dynamax": lambda: peers.task("dynamax_ekf", f"{name}/gradient"),
    }
    if name == "double_well":
        makers["cuthbert"] = lambda: peers.task("cuthbert_filters", f"{name}/gradient")
    return compare(f"EKF, {title}: value and gradient", makers)


def ekf(peers: Peers) -> list[Row]:
    rows = []
    for name, title in (
        ("double_well", "double well, 4 parameters"),
        ("mass_spring_damper", "mass-spring-damper, 9 parameters"),
    ):
        rows += ekf_value(peers, name, title) + ekf_gradient(peers, name, title)
    return rows


def linear(peers: Peers) -> list[Row]:
    def pymc_extras(mode):
        environment = ".venv-bench-pymc-extras"
        return lambda: peers.task("pymc_extras_kalman", f"linear/value/{mode}", environment)

    return compare(
        "Kalman filter, linear oscillator, 4 parameters",
        {
            OURS: ours.of("linear", psf.EKF()).value,
            "pymc-extras, JAX mode": pymc_extras("jax"),
            "pymc-extras, numba mode": pymc_extras("numba"),
        },
    )


def enkf(peers: Peers) -> list[Row]:
    rows = []
    for name, title in (
        ("double_well", "double well"),
        ("mass_spring_damper", "mass-spring-damper"),
    ):
        by_enkf = ours.of(name, psf.EnKF(1250))
        makers = {
            OURS: by_enkf.value,
            HELD: by_enkf.on_held_noise,
            PROPAGATION: lambda name=name: propagation(name, 1250),
            f"{O2}, noise held": lambda name=name: held_cpp(O2, name, "enkf", 1250),
            f"{FAST}, noise held": lambda name=name: held_cpp(FAST, name, "enkf", 1250),
        }
        if name == "double_well":
            makers["cuthbert"] = lambda: peers.task("cuthbert_filters", "double_well/enkf/1250")
            makers["DAPPER"] = lambda: peers.task("dapper_enkf", "double_well/enkf/1250")
        rows += compare(
            f"EnKF, {title}, 1250 members",
            makers,
            n_seeds=N_SEEDS,
            without_answer=(PROPAGATION,),
            notes={
                "cuthbert": "its likelihood is the Gaussian fit",
                "DAPPER": "a likelihood added, its statistics left out",
            },
        )
    return rows


def bootstrap(peers: Peers) -> list[Row]:
    return compare(
        "Bootstrap filter, double well, 1250 particles",
        {
            OURS: ours.of("double_well", psf.BootstrapPF(1250)).value,
            HELD: ours.of("double_well", psf.BootstrapPF(1250)).on_held_noise,
            "cuthbert": lambda: peers.task("cuthbert_filters", "double_well/bootstrap/1250"),
            "particles": lambda: peers.task("particles_bootstrap", "double_well/bootstrap/1250"),
        },
        n_seeds=N_SEEDS,
    )


def pf_enkf(peers: Peers) -> list[Row]:
    rows = []
    for name, title, n in (
        ("double_well", "double well", 1000),
        ("mass_spring_damper", "mass-spring-damper", 1250),
    ):
        by_pf_enkf = ours.of(name, psf.PFEnKF(n))
        rows += compare(
            f"PF-EnKF, {title}, {n} particles",
            {
                OURS: by_pf_enkf.value,
                HELD: by_pf_enkf.on_held_noise,
                f"{O2}, noise held": lambda name=name, n=n: held_cpp(O2, name, "pf_enkf", n),
                f"{FAST}, noise held": lambda name=name, n=n: held_cpp(FAST, name, "pf_enkf", n),
            },
            rounds=5,
            n_seeds=N_SEEDS // 4,
            notes={f"{options}, noise held": "exact kernel densities" for options in OPTIONS},
        )
    return rows


def grid(peers: Peers) -> list[Row]:
    return compare(
        "Deterministic filters, double well",
        {
            "GridFilter": ours.of("double_well", psf.GridFilter()).value,
            "EKF": ours.of("double_well", psf.EKF()).value,
        },
    )


def epidemic(peers: Peers) -> list[Row]:
    """One likelihood of counts, with a resampling at every observation in both."""
    system, truth, record = seir.EPIDEMIC, seir.TRUTH, seir.record()
    filter = psf.BootstrapPF(1000, resample_below=1.0)
    by_filter = ours.Likelihood(system, filter, truth, steps=seir.STEPS, observed=record)
    return compare(
        "Bootstrap filter, SEIR epidemic, 1000 particles",
        {
            OURS: by_filter.value,
            "pypomp": lambda: peers.task("pypomp_epidemic", "epidemic/bootstrap/1000"),
        },
        n_seeds=N_SEEDS,
        notes={"pypomp": "single precision, approximate counts"},
    )


def held_cpp(options: str, name: str, filter: str, n_members: int) -> Timed:
    return Cpp(options, FOLDER, name, filter).on_held_noise(n_members)
