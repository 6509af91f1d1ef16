"""One small tree of named errors and warnings.

A mistake in what the user wrote is an exception raised before any number is computed. A failure
inside a filter is a value (minus infinity and a counted reason); what is said about it afterwards
is a warning.
"""


class StateSpaceFiltersError(Exception):
    """Root of every error that the package raises on purpose."""


class ModelError(StateSpaceFiltersError, ValueError):
    """An argument of a system, a filter or a data set is wrong; the message names it."""


class DataMismatchError(StateSpaceFiltersError, ValueError):
    """Results that belong to different data or different models were brought together."""


class LoweringError(StateSpaceFiltersError):
    """A user's function contains an operation that cannot be turned into machine code."""


class GradientUnavailableError(StateSpaceFiltersError):
    """A gradient sampler was pointed at a likelihood that is an estimate and has no gradient.

    Not a subclass of ``NotImplementedError``: PyMC takes that one for "sample this variable with
    Slice", which on an estimated likelihood gives silently wrong answers.
    """


class FilterWarning(UserWarning):
    """A filter's numbers should not be trusted as they stand."""


class EvidenceWarning(UserWarning):
    """An evidence estimate is less certain than its number looks."""


class CheckpointWarning(UserWarning):
    """A part of a checkpoint is damaged; the chain goes on from what stands before it."""
