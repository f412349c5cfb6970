"""Memory that the C library gives back to the system too eagerly for programs that ask for the same again at once."""

import ctypes

# of glibc's malloc.h
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4


def keep_freed_memory() -> bool:
    """Let the process keep what it frees, for a training step asks for the same hundreds of megabytes as the one before.

    By default glibc returns them, and the next step pays for every page of 4 KiB anew: up to 40 % of its time on a CPU.
    For programs of our own; a library leaves the process to its host, which can set ``MALLOC_TRIM_THRESHOLD_`` and
    ``MALLOC_MMAP_MAX_`` in the environment.

    Returns: whether the C library is one that can.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # not glibc: musl, macOS, Windows
        return False
    return bool(mallopt(_TRIM_THRESHOLD, -1)) and bool(mallopt(_MMAP_MAX, 0))
