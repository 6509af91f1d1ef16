"""A filter from its short form, ``GuidedPF(100, resample_below=0.4)``, which results store."""

import ast
from typing import Any

from .bootstrap import BootstrapPF
from .ekf import EKF
from .enkf import EnKF
from .finite_state import FiniteStateFilter
from .grid import GridFilter
from .guided_pf import GuidedPF
from .imm import IMM
from .iplf import IPLF
from .pf_enkf import PFEnKF
from .protocol import Filter
from .rbpf import RBPF
from .ukf import UKF

_FILTERS: dict[str, Any] = {
    one.__name__: one
    for one in (
        EKF, IMM, IPLF, RBPF, UKF, BootstrapPF, EnKF, FiniteStateFilter, GridFilter, GuidedPF,
        PFEnKF,
    )
}  # fmt: skip


def filter_from(text: str) -> Filter | None:
    """The filter that `recommendation.short_form` has written; None of a user's own class.

    Examples
    --------
    >>> filter_from("EnKF(50, likelihood='gaussian')").n_members
    50
    """
    try:
        return _value(ast.parse(text, mode="eval").body)
    except (SyntaxError, ValueError, KeyError):
        return None


def _value(node: ast.expr) -> Any:
    """A filter, or a literal among its settings."""
    if not isinstance(node, ast.Call):
        return ast.literal_eval(node)
    assert isinstance(node.func, ast.Name)
    settings = {one.arg: _value(one.value) for one in node.keywords if one.arg}
    return _FILTERS[node.func.id](*map(_value, node.args), **settings)
