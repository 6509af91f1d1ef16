"""A filter as a user would write it, ``GuidedPF(100, resample_below=0.4)``, and back."""

import ast
from collections.abc import Iterable
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from typing import Any

from .protocol import Filter


def short_form(filter: Any) -> str:
    """A filter as a user would write it: ``GuidedPF(100)``, without settings at their defaults."""
    if not is_dataclass(filter) or isinstance(filter, type):
        return str(filter)
    arguments = []
    for field in fields(filter):
        value = getattr(filter, field.name)
        if field.default is MISSING and not field.kw_only:
            arguments.append(repr(value))
        elif value != field.default:
            arguments.append(f"{field.name}={value!r}")
    return f"{type(filter).__name__}({', '.join(arguments)})"


def listed(filters: Iterable[Filter]) -> str:
    """The short forms of filters, with commas."""
    return ", ".join(map(short_form, filters))


def filter_from(text: str) -> Filter | None:
    """The filter that `short_form` has written; None of a user's own class.

    Examples
    --------
    >>> filter_from("EnKF(50, likelihood='gaussian')").n_members
    50
    """
    try:
        return _value(ast.parse(text, mode="eval").body)
    except (SyntaxError, ValueError, AttributeError):
        return None


def _value(node: ast.expr) -> Any:
    """A filter, or a literal among its settings."""
    if not isinstance(node, ast.Call):
        return ast.literal_eval(node)
    assert isinstance(node.func, ast.Name)
    settings = {one.arg: _value(one.value) for one in node.keywords if one.arg}
    kind = getattr(import_module(__package__), node.func.id)
    return kind(*map(_value, node.args), **settings)
