"""The errors and warnings of the package.

A wrong argument raises an exception before anything is computed. A failure inside a filter is a
value (minus infinity and a counted reason), reported by a warning afterwards.
"""

import contextlib
import functools
import warnings
from pathlib import Path

__all__ = [
    "CheckpointError",
    "CheckpointWarning",
    "DataMismatchError",
    "EvidenceWarning",
    "FilterWarning",
    "GradientUnavailableError",
    "LoweringError",
    "ModelError",
    "ModelWarning",
    "ParallelError",
    "ParallelWarning",
    "StateSpaceFiltersError",
]

# Files between a warning and the line of the user: the package, and its decorators. Python 3.13
# compares prefixes with a name without its last letter, so these are shorter than the whole name.
INSIDE = (
    str(Path(__file__).parent),
    *(name.removesuffix(".py") for name in (contextlib.__file__, functools.__file__)),
)


def warn(text: str, kind: type[Warning], *between: str) -> None:
    """Warn at the line of the user, behind files with other prefixes where these are in between."""
    warnings.warn(text, kind, skip_file_prefixes=(*INSIDE, *between))


class StateSpaceFiltersError(Exception):
    """Base class of all errors that the package raises deliberately.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> try:
    ...     psf.EnKF(1)
    ... except psf.errors.StateSpaceFiltersError as error:
    ...     print(type(error).__name__)
    ModelError
    """


class ModelError(StateSpaceFiltersError, ValueError):
    """A wrong argument of a system, a filter or a data set; the message names the argument.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.EnKF(1)
    Traceback (most recent call last):
    pymc_statespace_filters.errors.ModelError: n_members must be an integer from 2 to 1e+08, got 1.
    """


class DataMismatchError(StateSpaceFiltersError, ValueError):
    """Results of different data or different models were combined.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> from pymc_statespace_filters.evidence import Evidence
    >>> facts = {"se": 0.1, "estimator": "bridge", "n_parameters": 1, "n_observations": 20}
    >>> facts |= {"max_log_likelihood": -28.0}
    >>> rivals = {
    ...     name: Evidence(log_evidence=-30.0, data_fingerprint=name, **facts)
    ...     for name in ("this record", "another record")
    ... }
    >>> psf.compare_evidence(rivals)
    Traceback (most recent call last):
    pymc_statespace_filters.errors.DataMismatchError: ...
    """


class LoweringError(StateSpaceFiltersError):
    """A user's function contains an operation that cannot be compiled.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> import pytensor.tensor as pt
    >>> from pytensor import wrap_py
    >>> @wrap_py(itypes=[pt.dvector], otypes=[pt.dvector])
    ... def half(x):
    ...     return x / 2
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x: pt.specify_shape(half(x), (1,)),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[1.0]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> psf.log_likelihood(system, psf.EnKF(10), {}, [0.0], steps=[1])
    Traceback (most recent call last):
    pymc_statespace_filters.errors.LoweringError: ...
    """


class GradientUnavailableError(StateSpaceFiltersError):
    """A gradient sampler was used on an estimated likelihood, which has no gradient.

    Not a subclass of ``NotImplementedError``, on which PyMC would fall back to its slice sampler:
    with an estimated likelihood that sampler is wrong without any error.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> walk = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> with pm.Model():
    ...     a = pm.Uniform("a", 0, 1)
    ...     d = psf.StateSpace("d", walk, psf.BootstrapPF(10), steps=[1, 2], observed=[0.3, 1.2])
    ...     try:
    ...         pm.sample(progressbar=False)
    ...     except psf.errors.GradientUnavailableError as error:
    ...         print("DRAM" in str(error))
    True
    """


class ParallelError(StateSpaceFiltersError, RuntimeError):
    """MPI cannot be used as requested, or another rank has stopped the run.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> issubclass(psf.errors.ParallelError, RuntimeError)
    True
    """


class ParallelWarning(UserWarning):
    """The ranks of a run differ, so that its results are not reproducible bit for bit.

    Examples
    --------
    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", psf.errors.ParallelWarning)
    """


class ModelWarning(UserWarning):
    """The model is probably not the one that was meant, for example because of a misspelt name.

    Examples
    --------
    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", psf.errors.ModelWarning)
    """


class FilterWarning(UserWarning):
    """A filter failed or collapsed, so its results may be unreliable.

    Examples
    --------
    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", psf.errors.FilterWarning)
    """


class EvidenceWarning(UserWarning):
    """An evidence estimate may be less accurate than its standard error says.

    Examples
    --------
    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", psf.errors.EvidenceWarning)
    """


class CheckpointError(StateSpaceFiltersError, OSError):
    """A file of a checkpoint cannot be written or read, for example because the disk is full.

    What was stored before is kept, and the same call resumes from there.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> issubclass(psf.errors.CheckpointError, OSError)
    True
    """


class CheckpointWarning(UserWarning):
    """A part of a checkpoint is damaged; the chain resumes from the last intact record.

    Examples
    --------
    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", psf.errors.CheckpointWarning)
    """
