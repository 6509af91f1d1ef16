"""Our filters compared with hand-written loops, in a minute: run it before a release.

``python -m benchmarks.quick`` (or ``make bench-quick``) needs no other package and no compiler.
"""

import warnings

import pymc_statespace_filters as psf
from benchmarks import likelihoods, ours
from benchmarks.__main__ import on_one_core
from benchmarks.chains import microseconds_a_draw
from benchmarks.report import number, seconds
from benchmarks.timing import Timed, in_turn


def contenders(name: str) -> dict[str, Timed]:
    by_ekf, by_enkf = ours.of(name, psf.EKF()), ours.of(name, psf.EnKF(1250))
    found = {
        "EKF by hand": likelihoods.ekf_by_hand(name),
        "EKF": by_ekf.value(),
        "EKF, called from Python": by_ekf.called_from_python(),
        "EKF, with gradient": by_ekf.value_and_gradient(),
        "EKF, a point of 32": by_ekf.batch(32),
        "propagation by hand": likelihoods.propagation(name, 1250),
        "EnKF(1250)": by_enkf.value(),
        "BootstrapPF(1250)": ours.of(name, psf.BootstrapPF(1250)).value(),
        "PFEnKF(1250)": ours.of(name, psf.PFEnKF(1250)).value(),
    }
    if name == "double_well":
        found["GridFilter()"] = ours.of(name, psf.GridFilter()).value()
    return found


def main() -> None:
    warnings.simplefilter("ignore")
    on_one_core()
    for name in ("double_well", "mass_spring_damper"):
        found = contenders(name)
        for contender in found.values():
            contender.warm_up()
        times = {who: t.median for who, t in in_turn(found, 5).items()}
        print(f"\n{name.replace('_', ' ')}")
        for who, t in times.items():
            base = "EKF by hand" if who.startswith("EKF") else "propagation by hand"
            print(f"  {who:26} {seconds(t):>9}  {number(t / times[base]):>6} x {base}")
    print("\noverhead of a compiled chain")
    for what, tune in (("a draw", False), ("an iteration of warm-up", True)):
        print(f"  {what:26} {microseconds_a_draw(tune=tune, n=50_000):6.2f} µs")


if __name__ == "__main__":
    main()
