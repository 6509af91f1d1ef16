"""Equations of FitzHugh and Nagumo of unknown form, as free fields of 100 coefficients each.

``python -m benchmarks.fitzhugh_nagumo [--seeds 1 2] [--seen vw] [--free vw] [--noise 0.1]`` samples
each record by `sample` with its defaults. ``--seen v`` hides w, ``--free w`` leaves the equation of
v known. The record has 500 rows, 0.1 apart, measured with the variance 0.01; the process noise of a
step has the variance 0.01 dt, or with ``--noise 0.01`` the variance 0.0001 dt. Both are known.

For each record it prints: CPU seconds of the call with the search for starts and compilation; how
many draws of NUTS diverged; the sampler; of the coefficients the largest R-hat and the smallest
effective number of draws, of the bulk and of the tails; of the log-likelihood the R-hat, and how
far it is at the posterior mean above that of the true equations; for each field the root mean
square error of its mean at the true states of the record, and the share of them at which its 90 %
band has the truth. What the package warns of, or logs as a warning, follows.
"""

import argparse
import logging
import os
import time
import warnings

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"}

import numpy as np
import pymc as pm
import xarray as xr
from arviz_stats.base import array_stats

import pymc_statespace_filters as psf
from benchmarks.reached import tail_ess

N_ROWS, DT, SENSOR = 500, 0.1, 0.1
BASIS = psf.mechanics.gaussian_process_terms(["v", "w"], [(-4, 4), (-4, 4)], 10)
AMPLITUDES = {"v": 2.0, "w": 0.2}  # standard deviations of the fields; their length is one
KNOWN = {
    "v": lambda x: x[0] - x[0] ** 3 / 3 - x[1] + 0.5,
    "w": lambda x: 0.08 * (x[0] + 0.7 - 0.8 * x[1]),
}


# The equations by the names of those that are fields.
DRIFTS = {
    "": lambda x: [KNOWN["v"](x), KNOWN["w"](x)],
    "v": lambda x, c_v: [c_v @ BASIS(x), KNOWN["w"](x)],
    "w": lambda x, c_w: [KNOWN["v"](x), c_w @ BASIS(x)],
    "vw": lambda x, c_v, c_w: [c_v @ BASIS(x), c_w @ BASIS(x)],
}


def system(seen: str, free: str, noise: float) -> psf.StateSpaceModel:
    """The equations of which the ``free`` ones are fields with the coefficients c_v and c_w."""
    return psf.StateSpaceModel(
        states=["v", "w"],
        transition=psf.EulerMaruyama(DRIFTS[free], noise * np.eye(2), dt=DT),
        observation=lambda x: [x["vw".index(k)] for k in seen],
        observation_noise=SENSOR**2 * np.eye(len(seen)),
        initial_mean=[0.0, 0.0],
        initial_cov=np.eye(2),
        shapes={f"c_{k}": (len(BASIS),) for k in free},
    )


def posterior(seed: int, seen: str, free: str, noise: float) -> tuple[pm.Model, xr.Dataset]:
    """The model of a record, and the true states and observations."""
    steps = np.arange(N_ROWS)
    made = psf.simulate(system("vw", "", noise), {}, steps=steps, random_seed=seed)
    with pm.Model() as model:
        for k in free:
            pm.Normal(f"c_{k}", 0, BASIS.prior_sd(1.0, AMPLITUDES[k]).eval(), shape=len(BASIS))
        observed = made["observations"].values[:, ["vw".index(k) for k in seen]]
        psf.StateSpace("d", system(seen, free, noise), psf.EKF(), steps=steps, observed=observed)
    return model, made


def sampled(seed: int, seen: str, free: str, noise: float) -> tuple[str, xr.DataTree, list[str]]:
    """The line of a record, its draws, and what was warned of."""
    model, made = posterior(seed, seen, free, noise)
    said, handler = [], logging.Handler(logging.WARNING)
    handler.emit = lambda record: said.append(record.getMessage())
    logging.getLogger("pymc").addHandler(handler)
    began = time.process_time()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        idata = psf.sample(model=model, random_seed=seed, progressbar=False)
    seconds = time.process_time() - began
    logging.getLogger("pymc").removeHandler(handler)
    said += [str(warning.message) for warning in warned]
    draws = {k: idata["posterior"][f"c_{k}"].values for k in free}
    columns = np.moveaxis(np.concatenate(list(draws.values()), axis=2), 2, 0)
    bulk, tail = min(map(array_stats.ess, columns)), min(map(tail_ess, columns))
    rhat = max(map(array_stats.rhat, columns))
    stats = idata["sample_stats"].to_dataset()
    n_diverging = int(stats["diverging"].sum()) if "diverging" in stats else 0

    record = {"steps": np.arange(N_ROWS), "observed": model.rvs_to_values[model["d"]].data}
    fitted, true = system(seen, free, noise), system(seen, "", noise)
    rows = {f"c_{k}": c.reshape(-1, len(BASIS)) for k, c in draws.items()}
    density = psf.log_likelihood(fitted, psf.EKF(), rows, **record)
    density_rhat = array_stats.rhat(density.sum(axis=-1).reshape(columns.shape[1:]))
    means = {name: c.mean(axis=0) for name, c in rows.items()}
    above = psf.log_likelihood(fitted, psf.EKF(), means, **record)
    above = (above - psf.log_likelihood(true, psf.EKF(), {}, **record)).sum()
    states = made["states"].values.T
    values, fields = BASIS(states).eval(), []
    for k in free:
        field, truth = rows[f"c_{k}"] @ values, KNOWN[k](states)
        rmse = np.sqrt(((field.mean(axis=0) - truth) ** 2).mean())
        low, high = np.quantile(field, [0.05, 0.95], axis=0)
        covered = ((low < truth) & (truth < high)).mean()
        fields.append(f"{k} rmse {rmse:.3f} (of {truth.std():.3f}) covered {covered:.2f}")
    line = (
        f"seen {seen}, free {free}, noise {noise}, seed {seed}: {seconds:.0f} s, "
        f"{n_diverging} diverged, {idata.attrs['sampler']}, rhat {rhat:.3f}, "
        f"ess {bulk:.0f} {tail:.0f}, log-likelihood rhat {density_rhat:.3f}, at the mean "
        f"{above:+.1f}; {', '.join(fields)}"
    )
    return line, idata, said


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fitzhugh_nagumo",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--seen", choices=["vw", "v"], default="vw")
    parser.add_argument("--free", choices=["vw", "v", "w"], default="vw")
    parser.add_argument("--noise", type=float, default=0.1)
    parser.add_argument("--keep", metavar="FOLDER", help="write the draws there, as NetCDF")
    options = parser.parse_args()
    for seed in options.seeds:
        line, idata, said = sampled(seed, options.seen, options.free, options.noise)
        print(line, *said, sep="\n  ", flush=True)
        if options.keep:
            name = f"seen_{options.seen}_free_{options.free}_noise_{options.noise}_{seed}.nc"
            idata.to_netcdf(os.path.join(options.keep, name))


if __name__ == "__main__":
    main()
