"""Exact stochastic simulation of an SEIR epidemic with births and deaths, event by event.

Gillespie's direct method (1977): exponential waiting times, one event at a time. Exits of infected
compartments count as cases when they recover.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray


class Epidemic(NamedTuple):
    """Rates per day, the population, and the start."""

    population: float
    infection: float  # of a susceptible by an infectious one, times the population
    latency: float = 1 / 8
    recovery: float = 1 / 5
    turnover: float = 1 / 2000  # births per head, and deaths
    imported: float = 2.0
    susceptible: float = 0.1  # as fractions of the population
    exposed: float = 0.002
    infectious: float = 0.001

    @property
    def start(self) -> NDArray[np.float64]:
        """S, E and I at day 0, whole numbers."""
        fractions = [self.susceptible, self.exposed, self.infectious]
        return np.round(self.population * np.array(fractions))


def simulate(epidemic: Epidemic, n_weeks: int, n_paths: int, seed: int) -> NDArray[np.float64]:
    """Cases of every week, shape (n_paths, n_weeks)."""
    rng = np.random.default_rng(seed)
    rates = np.array(epidemic[:6])
    return np.stack([_simulate(rng, rates, epidemic.start, n_weeks) for _ in range(n_paths)])


@njit(error_model="numpy")
def _simulate(rng, rates, start, n_weeks):
    population, infection, latency, recovery, turnover, imported = rates
    S, E, I = start  # noqa: E741
    cases, week, t = np.zeros(n_weeks), 0, 0.0
    while True:
        birth, infect = turnover * population, infection * S * (I + imported) / population
        emerge, recover = latency * E, recovery * I
        total = birth + infect + emerge + recover + turnover * (S + E + I)
        t += rng.standard_exponential() / total
        while t > 7.0 * (week + 1):
            week += 1
            if week == n_weeks:
                return cases
        choice = total * rng.random()
        if choice < birth:
            S += 1
        elif choice < birth + infect:
            S, E = S - 1, E + 1
        elif choice < birth + infect + emerge:
            E, I = E - 1, I + 1  # noqa: E741
        elif choice < birth + infect + emerge + recover:
            I, cases[week] = I - 1, cases[week] + 1  # noqa: E741
        else:
            choice -= birth + infect + emerge + recover
            if choice < turnover * S:
                S -= 1
            elif choice < turnover * (S + E):
                E -= 1
            else:
                I -= 1  # noqa: E741
