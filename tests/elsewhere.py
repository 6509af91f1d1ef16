"""A plugin of pytest that takes away what Linux has and other systems lack: `-p tests.elsewhere`.

Calls that Windows or macOS do not have are removed, files below /proc are not found, a folder
cannot be opened, and an open file can be neither removed nor renamed. In the environment `PLAIN`
text is ASCII unless an encoding is given.

What the names below stand for in the interpreter's own modules stays as it is: filelock, for
example, knows its system, and its files are left alone.
"""

import builtins
import errno
import io
import os
import shutil
import signal
from pathlib import Path

PLAIN = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
"""The variables of an environment whose encoding is ASCII."""

MISSING = {
    os: (
        "fchmod", "fork", "forkpty", "geteuid", "getloadavg", "killpg", "mkfifo",
        "posix_fadvise", "pread", "pwrite", "sched_getaffinity",
        "sched_setaffinity", "setsid", "sysconf", "uname", "wait4",
    ),
    signal: (
        "SIGALRM", "SIGHUP", "SIGQUIT", "SIGSTOP", "SIGUSR1", "SIGUSR2", "alarm",
        "pause", "pthread_kill", "pthread_sigmask", "setitimer", "siginterrupt", "sigwait",
    ),
}  # fmt: skip

_open_file, _open_descriptor, _readlink = builtins.open, os.open, os.readlink
_remove = {name: getattr(os, name) for name in ("remove", "rename", "replace", "unlink")}


def _error(number, path):
    return OSError(number, os.strerror(number), os.fspath(path))


def _check_exists(path):
    if isinstance(path, str | Path) and os.fspath(path).startswith("/proc/"):
        raise _error(errno.ENOENT, path)


def _open(file, *args, **kwargs):
    _check_exists(file)
    return _open_file(file, *args, **kwargs)


def _os_open(path, *args, **kwargs):
    _check_exists(path)
    if os.path.isdir(path):
        raise _error(errno.EACCES, path)
    return _open_descriptor(path, *args, **kwargs)


def _os_readlink(path, **kwargs):
    _check_exists(path)
    return _readlink(path, **kwargs)


def _is_open(path):
    """Whether this process has the file open."""
    files = set()
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            files.add(_readlink(f"/proc/self/fd/{descriptor}"))
        except FileNotFoundError:
            continue  # that of the list
    return os.path.realpath(path) in files


def _refusing_open_files(function):
    def call(path, *args, **kwargs):
        name = os.path.basename(os.fspath(path))
        if name != "run.lock" and _is_open(path):
            raise _error(errno.EACCES, path)
        return function(path, *args, **kwargs)

    return call


def pytest_configure():
    """Take it away, before any test is imported."""
    import pymc  # noqa: F401  # with what it imports, which is no subject of these tests

    for module, names in MISSING.items():
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    builtins.open = io.open = _open
    os.open, os.readlink = _os_open, _os_readlink
    for name, function in _remove.items():
        setattr(os, name, _refusing_open_files(function))
    shutil._use_fd_functions = False
