"""The most informative ratios, between rows that were measured in turn."""

from benchmarks.growth import Curve
from benchmarks.likelihoods import FAST, HELD, N_POINTS, O2, OURS, PROPAGATION
from benchmarks.measure import Row
from benchmarks.sampling import Chains

Ratio = tuple[str, float | None, str]
SYSTEMS = ("double well, 4 parameters", "mass-spring-damper, 9 parameters")


def ratios(rows: list[Row], growth: list[Curve], chains: list[Chains]) -> list[Ratio]:
    """Return description, ratio or None where one of the two is missing, and which way is good."""
    times = {(row.work, row.who): row.timing.median for row in rows if row.timing}

    def over(work: str, who: str, by: tuple[str, str]) -> float | None:
        top, bottom = times.get((work, who)), times.get(by)
        return top / bottom if top and bottom else None

    found: list[Ratio] = []
    for system in SYSTEMS:
        value, gradient = f"EKF, {system}: value", f"EKF, {system}: value and gradient"
        ours = (value, OURS)
        each = f"ours, {N_POINTS} points in one call, each"
        found += [
            (f"{value}: ours / loop by hand", over(*ours, (value, "numba loop by hand")), LESS),
            (f"{value}: JAX scan / ours", over(value, "JAX scan by hand", ours), MORE),
            (f"{value}: a point of {N_POINTS} / a point alone", over(value, each, ours), LESS),
            (f"EKF, {system}: ours with gradient / value", over(gradient, OURS, ours), LESS),
            (
                f"{gradient}: JAX scan / ours",
                over(gradient, "JAX scan by hand", (gradient, OURS)),
                MORE,
            ),
        ]
    for system in ("double well", "mass-spring-damper"):
        work = f"EnKF, {system}, 1250 members"
        bare = (work, PROPAGATION)
        found += [
            (f"{work}: noise held / propagation alone", over(work, HELD, bare), LESS),
            (f"{work}: noise refreshed / propagation alone", over(work, OURS, bare), LESS),
        ]
    for work in (
        "PF-EnKF, double well, 1000 particles",
        "PF-EnKF, mass-spring-damper, 1250 particles",
    ):
        for options in (O2, FAST):
            cpp = f"{options}, noise held"
            found.append(
                (f"{work}: {options} / ours, noise held", over(work, cpp, (work, HELD)), MORE)
            )
            found.append(
                (f"{work}: {options} / ours, refreshed", over(work, cpp, (work, OURS)), MORE)
            )
    return found + growth_ratios(growth) + sampler_ratios(chains)


def growth_ratios(growth: list[Curve]) -> list[Ratio]:
    found: list[Ratio] = []
    for curve in growth:
        at = dict(zip(curve.sizes, curve.seconds, strict=True))
        if curve.against == "particles" and 1000 in at:
            ratio = at[8000] / at[1000] if 8000 in at else None
            found.append((f"{curve.who}: 8000 particles / 1000", ratio, LESS))
    return found


def sampler_ratios(chains: list[Chains]) -> list[Ratio]:
    by_name = {c.sampler: c for c in chains if c.iterations_per_second == c.iterations_per_second}
    ours = [c for name, c in by_name.items() if "psf." in name]
    peers = [c for name, c in by_name.items() if "psf." not in name]
    return [
        ratio
        for us in ours
        for them in peers
        for ratio in (
            (
                f"draws per second: {us.sampler} / {them.sampler}",
                us.iterations_per_second / them.iterations_per_second,
                MORE,
            ),
            (
                f"ESS per second: {us.sampler} / {them.sampler}",
                us.ess_per_second / them.ess_per_second,
                MORE,
            ),
            (
                f"ESS per second, tuning left out: {us.sampler} / {them.sampler}",
                us.kept_ess_per_second / them.kept_ess_per_second,
                MORE,
            ),
        )
    ]


LESS, MORE = "less is better", "more is better"
