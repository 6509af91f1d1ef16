"""One small tree of named errors and warnings.

A mistake in what the user wrote is an exception raised before any number is computed. A failure
inside a filter is a value (minus infinity and a counted reason); what is said about it afterwards
is a warning.
"""


class StateSpaceFiltersError(Exception):
    """Root of every error that the package raises on purpose.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> try:
    ...     psf.EnKF(1)
    ... except psf.StateSpaceFiltersError as error:
    ...     print(type(error).__name__)
    ModelError
    """


class ModelError(StateSpaceFiltersError, ValueError):
    """An argument of a system, a filter or a data set is wrong; the message names it.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.EnKF(1)
    Traceback (most recent call last):
    pymc_statespace_filters.errors.ModelError: n_members must be an integer of at least 2, got 1.
    """


class DataMismatchError(StateSpaceFiltersError, ValueError):
    """Results that belong to different data or different models were brought together.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> facts = {"se": 0.1, "estimator": "bridge", "n_parameters": 1, "n_observations": 20}
    >>> facts |= {"max_log_likelihood": -28.0}
    >>> rivals = {
    ...     name: psf.Evidence(log_evidence=-30.0, data_fingerprint=name, **facts)
    ...     for name in ("this record", "another record")
    ... }
    >>> psf.compare_evidence(rivals)
    Traceback (most recent call last):
    pymc_statespace_filters.errors.DataMismatchError: ...
    """


class LoweringError(StateSpaceFiltersError):
    """A user's function contains an operation that cannot be turned into machine code.

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
    """A gradient sampler was pointed at a likelihood that is an estimate and has no gradient.

    Not a subclass of ``NotImplementedError``: PyMC takes that one for "sample this variable with
    Slice", which on an estimated likelihood gives silently wrong answers.

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
    ...     except psf.GradientUnavailableError as error:
    ...         print("DRAM" in str(error))
    True
    """


class ParallelError(StateSpaceFiltersError, RuntimeError):
    """MPI cannot be used as it was asked for, or another rank has stopped the run.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> issubclass(psf.ParallelError, RuntimeError)
    True
    """


class ParallelWarning(UserWarning):
    """The ranks of a run are not what a reproducible run needs.

    Examples
    --------
    To stop instead:

    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", psf.ParallelWarning)
    """


class FilterWarning(UserWarning):
    """A filter's numbers should not be trusted as they stand.

    Examples
    --------
    Where a doubt should stop a script:

    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", psf.FilterWarning)
    """


class EvidenceWarning(UserWarning):
    """An evidence estimate is less certain than its number looks.

    Examples
    --------
    A doubt that is known and accepted:

    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", psf.EvidenceWarning)
    """


class CheckpointWarning(UserWarning):
    """A part of a checkpoint is damaged; the chain goes on from what stands before it.

    Examples
    --------
    To stop instead and look at the folder:

    >>> import warnings
    >>> import pymc_statespace_filters as psf
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", psf.CheckpointWarning)
    """
