"""When `select_terms` doubts the draws that it is given, and whether it is right.

``python -m benchmarks.terms_poor_draws 5`` takes so many regressions of six terms, whose
probabilities are known in closed form, with good draws of the posterior and poor ones: of another
place, another width, too few, of chains that stick. A row for each kind has how many runs warned,
how many of these had no error to warn of (false alarms), how many were wrong without a warning
(silent), the largest error, and how well the draws suited the full model: effective points per
point of the proposal that they gave, and of the one in use.

An inclusion is wrong if it is off by more than four of its standard errors and 0.01.

Regression 1 without the last kind, and regression 2, are 25 cases. Two were wrong, with draws off
by 100 standard deviations, and warned; none was silent. Of the 23 that were right two warned (10
times as wide, off by 6), and none of the eight with good draws. Their largest error was 0.008.
"""

import sys
import warnings

import numpy as np
import pandas as pd
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.terms import guidance
from tests.terms.regression import Regression

KINDS = {
    "good": lambda x, rng: x,
    "good, 100 draws": lambda x, rng: x[:, :50],
    "good, 40 draws": lambda x, rng: x[:, :20],
    "good, autocorrelated": lambda x, rng: np.repeat(x[:, ::20], 20, axis=1),
    "3 times as wide": lambda x, rng: _scaled(x, 3.0),
    "10 times as wide": lambda x, rng: _scaled(x, 10.0),
    "a third as wide": lambda x, rng: _scaled(x, 1 / 3),
    "a tenth as wide": lambda x, rng: _scaled(x, 0.1),
    "off by 2 sd": lambda x, rng: x + 2 * x.std(axis=(0, 1)),
    "off by 6 sd": lambda x, rng: x + 6 * x.std(axis=(0, 1)),
    "off by 100 sd": lambda x, rng: x + 100 * x.std(axis=(0, 1)),
    "two chains apart": lambda x, rng: x + np.array([0, 6])[:, None, None] * x.std(axis=(0, 1)),
    "normal noise": lambda x, rng: 3 * rng.standard_normal(x.shape),
}


def _scaled(x, factor):
    return x.mean(axis=(0, 1)) + factor * (x - x.mean(axis=(0, 1)))


def one_run(regression, model, kind, seed):
    """What happened with draws of a kind."""
    posterior = regression.draws(seed)["posterior"]
    good = np.stack([posterior[name].values for name in regression.absent], axis=-1)
    x = KINDS[kind](good, np.random.default_rng(seed))
    x[..., -1] = abs(x[..., -1])  # has a half-normal slab
    variables = {
        name: (("chain", "draw"), one)
        for name, one in zip(regression.absent, np.moveaxis(x, -1, 0), strict=True)
    }
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset(variables)})
    worth = []
    full_model = guidance._full_model

    def watched(*given):
        points = full_model(*given)
        worth.append(points.efficiency)
        return points

    guidance._full_model = watched
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            terms = psf.select_terms(
                model, regression.absent, idata=idata, random_seed=seed, progressbar=False
            )["terms"]
    finally:
        guidance._full_model = full_model
    error = np.abs(terms["inclusion"].values - regression.inclusion())
    is_wrong = (error > 4 * terms["inclusion_se"].values + 0.01).any()
    said = {kind: any(word in str(one.message) for one in caught) for kind, word in WORDS.items()}
    warned = any(said.values())
    return said | {
        "false alarm": warned and not is_wrong,
        "silent": is_wrong and not warned,
        "wrong": is_wrong,
        "largest error": error.max(),
        "worth at first": worth[0],
        "worth": max(worth),
    }


WORDS = {"draws doubted": "draws of idata", "sub-models doubted": "sub-models with"}


def main(count, first=1):
    """Print the table of all kinds, over so many regressions."""
    rows = []
    for seed in range(first, first + count):
        regression = Regression(seed, n_terms=6)
        model = regression.model(as_system=False)
        for kind in KINDS:
            rows.append({"kind": kind} | one_run(regression, model, kind, seed))
            print(seed, rows[-1], file=sys.stderr, flush=True)
    table = pd.DataFrame(rows).groupby("kind", sort=False)
    counted = ["draws doubted", "sub-models doubted", "false alarm", "silent", "wrong"]
    shown = table[counted].sum()
    shown["largest error"] = table["largest error"].max()
    shown[["worth at first", "worth"]] = table[["worth at first", "worth"]].median()
    print(f"{count} runs of each kind")
    print(shown.round(3).to_string())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
