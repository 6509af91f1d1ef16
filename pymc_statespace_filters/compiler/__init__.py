"""From traced equations to machine code."""

try:
    import pytensor.link.numba.cache  # noqa: F401  (it makes the folder of compiled code)
except OSError as error:
    raise OSError(
        error.errno,
        f"PyTensor cannot write compiled code to {error.filename!r} ({error.strerror}): set "
        "PYTENSOR_FLAGS=base_compiledir=FOLDER, a folder that you may write to; its path has "
        "forward slashes, on Windows too",
    ) from error
