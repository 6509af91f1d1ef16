"""Work in threads that a terminal can follow and Ctrl-C ends."""

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait

_REFRESH_SECONDS = 0.1


def run_in_threads(
    parts: Sequence[Callable[[], None]],
    n_threads: int,
    *,
    n_done: Callable[[], int],
    stop: Callable[[], None],
    on_progress: Callable[[int], None],
) -> None:
    """Run parts of some work, and raise what a part raises.

    ``on_progress`` is called in this thread with what ``n_done`` has grown by. ``stop`` asks parts
    that are still running to end, after an error or an interrupt.
    """
    n_reported = 0
    with ThreadPoolExecutor(n_threads) as pool:
        pending = {pool.submit(part) for part in parts}
        try:
            while pending:
                done, pending = wait(pending, _REFRESH_SECONDS, return_when=FIRST_EXCEPTION)
                for future in done:
                    future.result()
                now = n_done()
                on_progress(now - n_reported)
                n_reported = now
        finally:
            stop()
