"""Names of places: constants in compiled functions."""

import pytest
from numba import njit, typeof, types
from numba.core.errors import TypingError

from pymc_statespace_filters.compiler.native.plan import RECORD, REQUEST
from pymc_statespace_filters.filters.plan import PLAN


def test_places_are_the_same_in_compiled_functions():
    @njit
    def compiled():
        return RECORD.theta, RECORD.n_starts, REQUEST.n_before, PLAN.n, PLAN.moves

    assert compiled() == (RECORD.theta, RECORD.n_starts, REQUEST.n_before, PLAN.n, PLAN.moves)


def test_a_place_that_is_not_there_is_an_error():
    with pytest.raises(TypingError, match="nothing"):
        njit(lambda: RECORD.nothing)()


def test_a_vector_of_places_is_not_built_to_read_one():
    """Numba would build a tuple wherever one of its numbers is read."""
    assert not isinstance(typeof(PLAN), types.BaseTuple)
    assert typeof(PLAN) != typeof(RECORD)
    assert typeof(PLAN) == typeof(type(PLAN)())
