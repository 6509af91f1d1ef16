"""What is asked of the states, and where the answers go."""

from typing import NamedTuple

import numpy as np

PREDICTED, FILTERED, SMOOTHED = range(3)
MOMENTS = {"predicted": PREDICTED, "filtered": FILTERED, "smoothed": SMOOTHED}
"""Given the observations before the step, up to and at the step, or all."""


class Rows(NamedTuple):
    """Results: mean, standard deviation and a draw of the state at the steps ``at``."""

    at: np.ndarray
    draw_seed: int
    mean: np.ndarray
    sd: np.ndarray
    drawn: np.ndarray
