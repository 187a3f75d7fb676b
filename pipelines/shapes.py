"""The checks that the nouns of the system make of their arrays when they are built.

Imports numpy alone.
"""

from __future__ import annotations

from numpy.typing import NDArray


def check_shape(owner: str, name: str, array: NDArray, expected: tuple[int | None, ...]) -> None:
    """Raise ValueError unless `array` has `expected` shape; None stands for any size."""
    ok = array.ndim == len(expected) and all(
        want is None or have == want for have, want in zip(array.shape, expected, strict=True)
    )
    if not ok:
        wanted = ", ".join("any" if n is None else str(n) for n in expected)
        raise ValueError(f"{owner}.{name}: expected shape ({wanted}), found {array.shape}")


def check_ids(owner: str, name: str, ids: NDArray, limits: tuple[int, int]) -> None:
    """Raise ValueError, naming the owner and its field, where an id lies outside [first, stop)."""
    first, stop = limits
    if len(ids) and not (first <= ids.min() and ids.max() < stop):
        raise ValueError(
            f"{owner}.{name}: expected ids from {first} to {stop - 1}, "
            f"found {ids.min()} to {ids.max()}"
        )
