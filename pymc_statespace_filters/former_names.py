"""Other names of arguments, former ones or those of relatives: an error says what is used."""

from collections.abc import Callable
from functools import wraps


def former_names[**P, R](**instead: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Refuse arguments that a function has not, each with the text that says what to do instead.

    Raises
    ------
    TypeError
        By the function returned, if it is called with such a name.

    Examples
    --------
    >>> @former_names(colour="use color")
    ... def paint(color):
    ...     return color
    >>> paint(colour="red")
    Traceback (most recent call last):
    TypeError: paint() has no argument 'colour': use color
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in kwargs:
                if name in instead:
                    raise TypeError(
                        f"{function.__name__}() has no argument {name!r}: {instead[name]}"
                    )
            return function(*args, **kwargs)

        return checked

    return decorate
